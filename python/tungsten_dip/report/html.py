"""Builds self-contained HTML pages: the page itself, and its parts as HTML.

``page.html`` is the page's frame, ``page.css`` and ``page.js`` are written into it. Texts given to these
functions are escaped, except for parts that are HTML themselves.
"""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

from tungsten_dip.buffers.image_file import write_image
from tungsten_dip.buffers.render_buffers import FloatImage
from tungsten_dip.report.preview import FALSE_COLORS


@dataclass(frozen=True)
class Picture:
    """Display-referred values in [0, 1], shape (height, width, 3), and what they show."""

    label: str
    pixels: FloatImage


@dataclass(frozen=True)
class View:
    """A part of a picture: its upper left corner as fractions of width and height, and the magnification."""

    label: str
    x: float
    y: float
    zoom: float


def page(title: str, subtitle: str, body: Iterable[str]) -> str:
    """Return a whole page; ``body`` are parts in HTML."""

    def text(name: str) -> str:
        return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")

    return Template(text("page.html")).substitute(
        title=escape(title),
        subtitle=escape(subtitle),
        style=text("page.css"),
        script=text("page.js"),
        body="\n".join(body),
    )


def figures(names_and_values: Iterable[tuple[str, str]]) -> str:
    """Return a row of the figures that matter most."""
    pairs = (
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in names_and_values
    )
    return f'<dl class="figures">{"".join(pairs)}</dl>'


def comparison(pictures: Sequence[Picture], left: int, right: int, views: Sequence[View] = ()) -> str:
    """Return pictures of one size, two at a time, on either side of a divider that drags and obeys keys.

    ``left`` and ``right`` are the indices shown at first. ``views`` are details to choose from.
    """
    height, width = pictures[0].pixels.shape[:2]

    def choice(name: str, options: str) -> str:
        return f"<label>{name} <select>{options}</select></label>"

    def labels(chosen: int) -> str:
        return "".join(
            f"<option{' selected' if index == chosen else ''}>{escape(picture.label)}</option>"
            for index, picture in enumerate(pictures)
        )

    choices = choice("Left", labels(left)) + choice("Right", labels(right))
    if views:
        whole = View("whole picture", 0, 0, 1)
        options = (
            f'<option value="{v.x:.4f} {v.y:.4f} {v.zoom:g}">{escape(v.label)}</option>'
            for v in (whole, *views)
        )
        choices += choice("View", "".join(options))
    shown = []
    for index, picture in enumerate(pictures):
        sides = " left" * (index == left) + " right" * (index == right)
        image = f'<img alt="{escape(picture.label)}" src="{data_uri(picture.pixels)}">'
        shown.append(f'<div class="picture{sides}">{image}</div>')
    return (
        f'<div class="compare"><div class="choices">{choices}</div>'
        f'<div class="divider" style="aspect-ratio: {width} / {height}">{"".join(shown)}'
        f"<span>{escape(pictures[left].label)}</span><span>{escape(pictures[right].label)}</span>"
        '<input type="range" min="0" max="100" step="0.1" value="50" aria-label="Divider"></div></div>'
    )


def gallery(pictures: Iterable[Picture], kind: str = "") -> str:
    """Return pictures with their labels below; ``kind`` "crops" shows them small, every pixel a square."""
    shown = (
        f'<figure><img alt="{escape(picture.label)}" src="{data_uri(picture.pixels)}">'
        f"<figcaption>{escape(picture.label)}</figcaption></figure>"
        for picture in pictures
    )
    return f'<div class="grid {kind}">{"".join(shown)}</div>'


def error_scale(most: float) -> str:
    """Return the key to the false colours of an error map whose brightest colour means ``most``."""
    colors = ", ".join(f"rgb({r} {g} {b})" for r, g, b in FALSE_COLORS)
    bar = f'<i style="background: linear-gradient(to right, {colors})"></i>'
    return f'<div class="scale">0%{bar}{most:.0%} of the radiance and more</div>'


def table(
    header: Sequence[str], rows: Iterable[Sequence[str]], numeric_from: int, best: Iterable[int] = ()
) -> str:
    """Return a table; columns from ``numeric_from`` on are numbers, the rows ``best`` are set off."""
    marked = set(best)

    def line(tag: str, cells: Sequence[str]) -> str:
        kinds = ["" if index < numeric_from else ' class="number"' for index in range(len(cells))]
        return "".join(f"<{tag}{k}>{escape(cell)}</{tag}>" for k, cell in zip(kinds, cells, strict=True))

    lines = []
    for index, row in enumerate(rows):
        kind = ' class="best"' if index in marked else ""
        lines.append(f"<tr{kind}>{line('td', row)}</tr>")
    return (
        f'<div class="scroll"><table><thead><tr>{line("th", header)}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def facts(names_and_values: Iterable[tuple[str, str]]) -> str:
    """Return names and values below one another."""
    rows = (f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in names_and_values)
    return f'<div class="scroll"><table>{"".join(rows)}</table></div>'


def bullets(lines: Sequence[str]) -> str:
    """Return a list of lines."""
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def data_uri(pixels: FloatImage) -> str:
    """Return a picture as the text of a PNG that a page can hold."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        write_image(path, pixels)
        return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")
