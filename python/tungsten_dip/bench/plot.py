"""Plots of what was measured, drawn by matplotlib: for files, and for pages that are light or dark."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from tungsten_dip.bench.methods import IN_TIME, NOISY, OIDN, OURS, PAPER, SAMPLES, SERIES
from tungsten_dip.bench.results import Measurement
from tungsten_dip.bench.sets import BenchSet
from tungsten_dip.bench.table import Row, SetRows
from tungsten_dip.buffers.atomic import replacing
from tungsten_dip.buffers.render_buffers import FloatImage
from tungsten_dip.scene.tonemap import display_from_radiance

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


METRICS = (
    ("psnr", "PSNR in dB, more is better", False),
    ("relmse", "relMSE, less is better", True),
    ("flip", "FLIP, less is better", False),
    ("hdrflip", "HDR-FLIP, less is better", False),
)
"""Attribute of `Comparison`, what it is called, and whether its axis is logarithmic."""

MARKERS = dict(zip(SERIES, "oosD^v", strict=True))
LINE_POINTS = 50
"""Points by which a line between two points is represented when labels avoid it."""

_JOINED = (OURS, IN_TIME, PAPER, SAMPLES, OIDN)


@dataclass(frozen=True)
class Colors:
    """Colours of a plot, ``series`` in the order of `SERIES`."""

    ink: str
    soft: str
    line: str
    series: tuple[str, ...]


PRINTED = Colors(
    "#0b0b0b", "#52514e", "#dddcd8", ("#2a78d6", "#c2410c", "#0f7b6c", "#a21caf", "#8a6500", "#5b5b66")
)

# Stand for the page's own colours, which differ in light and dark; `_for_page` puts those in their place.
_PAGE = Colors("#010101", "#010102", "#010103", tuple(f"#0102{index:02x}" for index in range(len(SERIES))))
_VARIABLES = {
    _PAGE.ink: "var(--ink)",
    _PAGE.soft: "var(--soft)",
    _PAGE.line: "var(--line)",
    **{color: f"var(--series-{index + 1})" for index, color in enumerate(_PAGE.series)},
}


def write_pareto_plot(folder: Path, found: Sequence[SetRows]) -> None:
    """Write one row of plots for every set as ``plot.svg`` and ``plot.png``."""
    with _figure(4.2 * len(METRICS), 3.6 * len(found) + 0.5) as figure:
        grid = figure.subplots(len(found), len(METRICS), squeeze=False)
        drawn = []
        for axes_of_set, each in zip(grid, found, strict=True):
            for axes, (name, title, logarithmic) in zip(axes_of_set, METRICS, strict=True):
                drawn.append((axes, _draw(axes, each.rows, name, logarithmic, PRINTED)))
                axes.set_title(f"{each.bench_set.name}: {title}", fontsize=9, loc="left", color=PRINTED.ink)
        handles, names = _handles(grid[0][0])
        figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False)
        _write_marks(figure, drawn)
        _save(figure, folder / "plot")


def pareto_svgs(each: SetRows) -> Iterator[tuple[str, str]]:
    """Yield (title, SVG in the page's colours) for every metric of a set."""
    for name, title, logarithmic in METRICS:
        with _figure(4.2, 3) as figure:
            axes = figure.subplots()
            _write_marks(figure, [(axes, _draw(axes, each.rows, name, logarithmic, _PAGE))])
            yield title, _for_page(figure, title)


def legend_html(rows: Sequence[Row]) -> str:
    """Return the names of the series that occur, each in its colour."""
    present = [series for series in SERIES if any(row.series == series for row in rows)]
    items = (
        f'<span style="color: var(--series-{SERIES.index(series) + 1})">\u25cf {series}</span>'
        for series in present
    )
    return f'<p class="legend">{" ".join(items)}</p>'


def _save(figure: Figure, path: Path) -> None:
    """Write a figure as .svg and .png, each whole or not at all, the same bytes for the same figure."""
    for suffix, metadata in ((".svg", {"Date": None}), (".png", {"Software": None})):
        with replacing(path.with_suffix(suffix)) as temporary:
            figure.savefig(temporary, facecolor="white", metadata=metadata)


@contextmanager
def _figure(width: float, height: float) -> Iterator[Figure]:
    """Yield a figure of that many inches."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "tungsten-dip", "font.size": 9}):
        yield Figure(figsize=(width, height), layout="constrained", dpi=144)


def _style(axes: Axes, colors: Colors) -> None:
    """Remove all that is not informative from axes."""
    axes.spines[["top", "right", "left", "bottom"]].set_visible(False)
    axes.patch.set_visible(False)
    axes.tick_params(which="both", length=0, labelcolor=colors.soft)
    axes.grid(color=colors.line, linewidth=0.7)
    axes.set_axisbelow(True)


@dataclass(frozen=True)
class _Mark:
    """A label beside a point of a plot, and its colour."""

    word: str
    seconds: float
    value: float
    color: str


def _draw(axes: Axes, rows: Sequence[Row], metric: str, logarithmic: bool, colors: Colors) -> list[_Mark]:
    """Draw one metric of every row over seconds, and return what is to be written beside the points."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    _style(axes, colors)
    axes.set_xscale("log")
    axes.set_yscale("log" if logarithmic else "linear")
    axes.set_xlabel("seconds", color=colors.soft, labelpad=1)
    marks = []
    for series, color in zip(SERIES, colors.series, strict=True):
        of_series = ((row, getattr(row.median, metric)) for row in rows if row.series == series)
        known = [(row, value) for row, value in of_series if value is not None]
        for row, value in known:
            if row.median.seconds is None:
                axes.axhline(value, color=color, linewidth=1, linestyle="--", label=series)
        timed = [
            (row.median.seconds, value, row.mark) for row, value in known if row.median.seconds is not None
        ]
        if timed:
            seconds, values, _ = zip(*timed, strict=True)
            line = "-" if series in _JOINED else ""
            axes.plot(seconds, values, line, color=color, marker=MARKERS[series], ms=4, lw=1.2, label=series)
            marks += [_Mark(mark, second, value, color) for second, value, mark in timed]
    axes.margins(x=0.12, y=0.12)
    _end_with_the_better(axes, rows, metric)
    for axis in (axes.xaxis, axes.yaxis) if logarithmic else (axes.xaxis,):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    return marks


def _end_with_the_better(axes: Axes, rows: Sequence[Row], metric: str) -> None:
    """Leave out what is worse than the noisy image, which would press all the rest together."""
    value_of = {row.label: value for row in rows if (value := getattr(row.median, metric)) is not None}
    noisy = value_of.pop(NOISY, None)
    if noisy is None:
        return
    sign = 1 if metric == "psnr" else -1
    better = [value for value in value_of.values() if sign * value >= sign * noisy and math.isfinite(value)]
    if better:
        scale = axes.yaxis.get_transform()
        ends = axes.yaxis.get_major_locator().nonsingular(min(better), max(better))
        low, high = scale.transform(ends)
        margin = 0.12 * (high - low)
        axes.set_ylim(*scale.inverted().transform([low - margin, high + margin]))


def _write_marks(figure: Figure, drawn: Sequence[tuple[Axes, Sequence[_Mark]]]) -> None:
    """Write the marks beside their points, each where it overlaps least."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    point = figure.dpi / 72
    for axes, marks in drawn:
        box = axes.get_window_extent()
        places = [axes.transData.transform((mark.seconds, mark.value)) for mark in marks]
        taken = [(x - 3 * point, y - 3 * point, x + 3 * point, y + 3 * point) for x, y in places]
        taken += [(x - point, y - point, x + point, y + point) for x, y in _points_on_lines(axes)]
        for mark, (x, y) in zip(marks, places, strict=True):
            if not mark.word or not box.y0 <= y <= box.y1:
                continue
            width, height = 4.6 * len(mark.word) * point, 8 * point
            free = [
                (left, bottom, left + width, bottom + height)
                for bottom in (y + 3 * point, y - 3 * point - height)
                for left in (x + 3 * point, x - 3 * point - width, x - width / 2)
                if box.x0 <= left and left + width <= box.x1 and bottom >= box.y0
            ]
            if not free:
                continue
            best = min(free, key=lambda place: sum(_overlap(place, other) for other in taken))
            taken.append(best)
            left, bottom = axes.transAxes.inverted().transform(best[:2])
            axes.text(left, bottom, mark.word, transform=axes.transAxes, color=mark.color, fontsize=7)


def _points_on_lines(axes: Axes) -> Iterator[tuple[float, float]]:
    """Yield points in pixels along all lines."""
    for line in axes.get_lines():
        if line.get_linestyle() == "None":
            continue
        corners = line.get_transform().transform(line.get_xydata())
        for (x0, y0), (x1, y1) in pairwise(corners.tolist()):
            for step in range(LINE_POINTS):
                along = step / LINE_POINTS
                yield x0 + along * (x1 - x0), y0 + along * (y1 - y0)


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Return the area that two boxes (left, bottom, right, top) share."""
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0)


def _handles(axes: Axes) -> tuple[list[Artist], list[str]]:
    handles, names = axes.get_legend_handles_labels()
    first = {name: handle for handle, name in zip(reversed(handles), reversed(names), strict=True)}
    return list(reversed(first.values())), list(reversed(first.keys()))


def _for_page(figure: Figure, title: str) -> str:
    stream = io.StringIO()
    figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    svg = stream.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    for color, variable in _VARIABLES.items():
        svg = svg.replace(color, variable)
    view = re.search(r'viewBox="[^"]*"', svg)
    assert view is not None
    head = f'<svg {view[0]} role="img" aria-label="{title} over seconds">'
    return re.sub(r"<svg[^>]*>", lambda _: head, svg, count=1)


def write_iterations_plot(
    folder: Path,
    bench_set: BenchSet,
    medians: Sequence[Measurement],
    images: Sequence[tuple[str, FloatImage]],
) -> None:
    """Write what iterations do to the published method's image: its PSNR as they go, and some images.

    The files are ``iterations.svg`` and ``iterations.png``.
    """
    from matplotlib.ticker import FuncFormatter, NullFormatter

    shown = [("noisy", bench_set.buffers.color.mean), *images, ("reference", bench_set.reference)]
    height, width = bench_set.reference.shape[:2]
    with _figure(10, 3.2 + 10 / len(shown) * height / width) as figure:
        grid = figure.add_gridspec(2, len(shown), height_ratios=(2.7, 10 / len(shown) * height / width))
        axes = figure.add_subplot(grid[0, :])
        _style(axes, PRINTED)
        axes.set_xscale("log")
        counts = [median.iterations or 0 for median in medians]
        for name, label, color in (("psnr_noisy", "to noisy", 1), ("psnr", "to reference", 0)):
            values = [getattr(median, name) for median in medians]
            axes.plot(counts, values, "o-", ms=4, lw=1.2, color=PRINTED.series[color], label=label)
        axes.set_xlabel("iterations", color=PRINTED.soft)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_title(f"{bench_set.name}: PSNR in dB", fontsize=9, loc="left", color=PRINTED.ink)
        axes.legend(frameon=False)
        for column, (label, image) in enumerate(shown):
            below = figure.add_subplot(grid[1, column])
            below.imshow(display_from_radiance(image), interpolation="antialiased")
            below.set_axis_off()
            below.set_title(label, fontsize=9, color=PRINTED.ink)
        _save(figure, folder / "iterations")
