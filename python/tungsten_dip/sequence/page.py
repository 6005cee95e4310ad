"""The page of a sequence: its frames as a strip, and how time, error and flicker went along."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from tungsten_dip.buffers.read import read_image
from tungsten_dip.report import html
from tungsten_dip.report.html import Picture
from tungsten_dip.report.line_plot import Label, Point, line_plot
from tungsten_dip.report.preview import block_means
from tungsten_dip.scene.tonemap import display_from_radiance
from tungsten_dip.sequence.work import Record

_MOST_PICTURES = 24
_PICTURE_WIDTH = 320
_PLOT_HEIGHT = 180

_FLICKER_NOTE = (
    "Relative squared error of the change from one frame to the next, at the same pixel, estimated without a "
    "reference from the two halves of the samples. Where their noise leaves no better estimate, it is the "
    "variance of the change: what the results of both halves have in common is then not in it."
)


def sequence_page(title: str, records: Sequence[Record]) -> str:
    """Return the page, in HTML that needs no network.

    Pictures are read from the records' outputs: all, or as many evenly spaced ones as a page can hold.
    """
    done = [record for record in records if record.error is None]
    body = [
        html.figures(_figures(records)),
        html.gallery(_strip(done), "crops"),
        "<h2>Time</h2>",
        _plot(done, "seconds", lambda record: record.seconds),
        "<h2>Estimated relMSE</h2>",
        _plot(done, "relMSE", lambda record: record.estimated_relmse),
        "<h2>Flicker</h2>",
        f"<p>{_FLICKER_NOTE}</p>",
        _plot(done, "flicker", lambda record: record.flicker),
        "<h2>Frames</h2>",
        html.table(("frame", "", "seconds", "steps", "estimated relMSE", "flicker"), map(_row, records), 2),
    ]
    return html.page(title, f"{len(records)} frames", body)


def _figures(records: Sequence[Record]) -> Iterator[tuple[str, str]]:
    by_how = {
        how: [record.seconds for record in records if record.how in kinds and record.error is None]
        for how, kinds in (("fitted", ("fitted", "cut")), ("followed", ("followed",)))
    }
    for how, seconds in by_how.items():
        if seconds:
            yield f"{how}, median", f"{len(seconds)} in {np.median(seconds):.2f} s each"
    flickers = [record.flicker for record in records if record.flicker is not None]
    if flickers:
        yield "flicker", f"{np.mean(flickers):.3g}"
    failures = sum(record.error is not None for record in records)
    if failures:
        yield "without a result", str(failures)


def _strip(done: Sequence[Record]) -> Iterator[Picture]:
    chosen = np.unique(np.linspace(0, len(done) - 1, min(len(done), _MOST_PICTURES)).round().astype(int))
    for record in (done[index] for index in chosen if done):
        color = read_image(Path(record.output))
        smaller = block_means(color, max(1, round(color.shape[1] / _PICTURE_WIDTH)))
        yield Picture(f"frame {record.number}", display_from_radiance(smaller.astype(np.float32)))


def _row(record: Record) -> tuple[str, ...]:
    if record.error is not None:
        return (str(record.number), record.error, "", "", "", "")
    known = (record.estimated_relmse, record.flicker)
    relmse, flickers = ("" if value is None else f"{value:.3g}" for value in known)
    return (str(record.number), record.how, f"{record.seconds:.2f}", str(record.iterations), relmse, flickers)


def _plot(records: Sequence[Record], what: str, value_of: Callable[[Record], float | None]) -> str:
    """Return an SVG of a value over the frames' numbers, from 0 up."""
    points = [(record.number, value) for record in records if (value := value_of(record)) is not None]
    if not points:
        return "<p>Not known.</p>"
    first, last = points[0][0], points[-1][0]
    top = max(max(value for _, value in points), 1e-12)
    span = max(last - first, 1)
    ends = [Label(0, f"frame {first}", "start"), Label(1, f"frame {last}", "end")]
    return line_plot(
        f"{what} of every frame",
        [
            Point((number - first) / span, value / top, f"frame {number}: {value:.3g}")
            for number, value in points
        ],
        below=ends if last > first else ends[:1],
        beside=[Label(share, f"{share * top:.3g}") for share in (0.0, 0.5, 1.0)],
        height=_PLOT_HEIGHT,
    )
