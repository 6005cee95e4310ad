"""The report: one HTML page that needs no network, with the pictures, the error and what led to them."""

from __future__ import annotations

import base64
import math
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np

from tungsten_dip.buffers.image_file import write_image
from tungsten_dip.buffers.model import FloatImage, RenderBuffers
from tungsten_dip.fit.settings import PAPER_SETTINGS, FitResult, HistoryPoint
from tungsten_dip.report.preview import FALSE_COLORS, error_in_false_color
from tungsten_dip.scene.tonemap import display_from_radiance

CURVE_WIDTH, CURVE_HEIGHT = 720, 260
CURVE_LEFT, CURVE_RIGHT, CURVE_TOP, CURVE_BOTTOM = 90, 24, 12, 56
"""Size of the plot and its margins in the units of the SVG."""


def report_page(
    title: str, buffers: RenderBuffers, result: FitResult, tonemap: str, remarks: Sequence[str] = ()
) -> str:
    """Return the page for one fit, its pictures displayed with one of Tungsten's tonemaps.

    ``remarks`` are lines on the input (what was taken for what, what was mended); the fit's notes follow,
    except for those that are among the remarks already.
    """
    template = Template(resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8"))
    return template.substitute(
        title=escape(title),
        subtitle=escape(_subtitle(buffers)),
        figures="".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in _figures(result)),
        width=buffers.width,
        height=buffers.height,
        noisy=_data_uri(display_from_radiance(buffers.color.mean, tonemap)),
        denoised=_data_uri(display_from_radiance(result.color, tonemap)),
        error_map=_error_map(result),
        false_colors=", ".join(f"rgb({r} {g} {b})" for r, g, b in FALSE_COLORS),
        curve=_curve(result.history),
        settings="".join(f"<tr><th>{name}</th><td>{value}</td></tr>" for name, value in _settings(result)),
        notes=_bullets(list(dict.fromkeys([*remarks, *result.notes]))),
    )


def _subtitle(buffers: RenderBuffers) -> str:
    size = f"{buffers.width} x {buffers.height} pixels"
    spp = "" if buffers.spp is None else f", {float(np.mean(buffers.spp)):g} samples per pixel"
    features = [name for name, _ in buffers.quantities() if name != "color"]
    return f"{size}{spp}, guided by {', '.join(features) or 'the colour alone'}"


def _figures(result: FitResult) -> Iterable[tuple[str, str]]:
    yield "time", f"{result.seconds:.1f} s"
    yield "iterations", str(result.iterations)
    if result.estimated_relmse is not None:
        yield "estimated relMSE", f"{result.estimated_relmse:.3g}"


def _settings(result: FitResult) -> Iterable[tuple[str, str]]:
    for name, value in asdict(result.settings).items():
        if value is None or (name in PAPER_SETTINGS and result.settings.preset != "paper"):
            continue
        yield (
            name.replace("_", " "),
            escape(", ".join(map(str, value)) if isinstance(value, tuple) else str(value)),
        )


def _bullets(lines: Sequence[str]) -> str:
    if not lines:
        return "<p>Nothing was missing and nothing had to be mended.</p>"
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def _error_map(result: FitResult) -> str:
    if result.error is None:
        return ""
    picture, most = error_in_false_color(result.error)
    return (
        f'<h2>Where the error is</h2><img alt="estimated error" src="{_data_uri(picture)}">'
        f'<div class="scale">0%<i></i>{most:.0%} of the radiance and more</div>'
    )


def _data_uri(picture: FloatImage) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        write_image(path, picture)
        return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")


def _curve(history: Sequence[HistoryPoint]) -> str:
    """Return the estimated relMSE over seconds as an SVG, its vertical axis logarithmic."""
    # An estimate without bias may fall below zero where the error is tiny; a logarithm cannot show it.
    known = [(p, relmse) for p in history if (relmse := p.estimated_relmse) is not None and relmse > 0]
    if len(known) < 2:
        return "<p>The buffers hold no independent evidence, so the error was not estimated on the way.</p>"
    seconds = [point.seconds for point, _ in known]
    levels = [math.log10(relmse) for _, relmse in known]
    bottom, top = math.floor(min(levels)), max(math.ceil(max(levels)), math.floor(min(levels)) + 1)

    def x(time_s: float) -> float:
        return CURVE_LEFT + time_s / max(seconds[-1], 1e-9) * (CURVE_WIDTH - CURVE_LEFT - CURVE_RIGHT)

    def y(level: float) -> float:
        return CURVE_TOP + (top - level) / (top - bottom) * (CURVE_HEIGHT - CURVE_TOP - CURVE_BOTTOM)

    parts = []
    right = CURVE_WIDTH - CURVE_RIGHT
    for exponent in range(bottom, top + 1):
        at, label = f"{y(exponent):.1f}", f"{10.0**exponent:g}"
        parts.append(f'<line class="grid" x1="{CURVE_LEFT}" x2="{right}" y1="{at}" y2="{at}"/>')
        parts.append(f'<text x="{CURVE_LEFT - 8}" y="{at}" dy="4" text-anchor="end">{label}</text>')
    step = _round_step(seconds[-1] / 6)
    for count in range(int(seconds[-1] / step) + 1):
        place = f'x="{x(count * step):.1f}" y="{CURVE_HEIGHT - CURVE_BOTTOM + 22}"'
        parts.append(f'<text {place} text-anchor="middle">{count * step:g}</text>')
    parts.append(f'<text x="{right}" y="{CURVE_HEIGHT - 6}" text-anchor="end">seconds</text>')
    line = " ".join(f"{x(time):.1f},{y(level):.1f}" for time, level in zip(seconds, levels, strict=True))
    parts.append(f'<polyline class="curve" points="{line}"/>')
    for (point, relmse), level in zip(known, levels, strict=True):
        told = f"{point.seconds:.1f} s, iteration {point.iteration}: relMSE {relmse:.3g}"
        place = f'cx="{x(point.seconds):.1f}" cy="{y(level):.1f}" r="3"'
        parts.append(f"<circle {place}><title>{told}</title></circle>")
    return (
        f'<p>Estimated relMSE, logarithmic.</p><svg viewBox="0 0 {CURVE_WIDTH} {CURVE_HEIGHT}" role="img" '
        f'aria-label="Estimated relMSE over seconds">{"".join(parts)}</svg>'
    )


def _round_step(least: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is no less."""
    power: float = 10.0 ** math.floor(math.log10(max(least, 1e-6)))
    return next(step for step in (power, 2 * power, 5 * power, 10 * power) if step >= least)
