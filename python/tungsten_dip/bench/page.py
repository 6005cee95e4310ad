"""The page of a benchmark: plots, tables, pictures side by side, details, error maps, the machine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape

import numpy as np

from tungsten_dip.bench.methods import NOISY, OURS
from tungsten_dip.bench.plot import legend_html, pareto_svgs
from tungsten_dip.bench.table import COLUMNS, SetRows, cells, repeats_text
from tungsten_dip.buffers.relmse import relative_squared_error
from tungsten_dip.buffers.render_buffers import FloatImage
from tungsten_dip.report import html
from tungsten_dip.report.html import Picture, View
from tungsten_dip.report.preview import block_means, error_in_false_color
from tungsten_dip.scene.tonemap import display_from_radiance

DETAILS = 2
DETAIL_FRACTION = 1 / 6
"""Side of a detail over the shorter side of the picture."""
MAP_WIDTH_PX = 320
"""Error maps are averaged down to about this width: they show where the error is, not its value per pixel."""


def pareto_page(found: Sequence[SetRows], machine: Sequence[tuple[str, str]], repeats: int) -> str:
    """Return the page, which is self-contained."""
    names = ", ".join(each.bench_set.name for each in found)
    body = [part for each in found for part in _set_parts(each)]
    body += ["<h2>Measured with</h2>", html.facts(machine)]
    return html.page("Accuracy against time", f"{names}; {repeats_text(repeats)}", body)


def _set_parts(each: SetRows) -> Iterator[str]:
    size = f"{each.bench_set.buffers.width} x {each.bench_set.buffers.height} pixels"
    yield f"<h2>{escape(each.bench_set.name)}</h2><p>{size}</p>"
    plots = (f"<figure><figcaption>{title}</figcaption>{svg}</figure>" for title, svg in pareto_svgs(each))
    yield f'{legend_html(each.rows)}<div class="grid plots">{"".join(plots)}</div>'
    yield (
        "<p>The plots leave out what is worse than the noisy image. Highlighted: no faster method has a "
        "lower relMSE.</p>"
    )
    yield html.table(COLUMNS, [cells(row) for row in each.rows], 1, each.front())

    images = {row.label: row.image for row in each.rows if row.image is not None}
    pictures = [Picture("reference", display_from_radiance(each.bench_set.reference))]
    pictures += [Picture(label, display_from_radiance(image)) for label, image in images.items()]
    denoised = [p.pixels for p in pictures if p.label not in ("reference", NOISY)]
    corners = _details(denoised or [p.pixels for p in pictures])
    side = _detail_side(pictures[0].pixels)
    height, width = pictures[0].pixels.shape[:2]
    views = [
        View(f"detail {index + 1}", x / width, y / height, min(height, width) / side)
        for index, (y, x) in enumerate(corners)
    ]
    ours = [index for index, p in enumerate(pictures) if _series(each, p.label) == OURS]
    left = next((index for index, p in enumerate(pictures) if p.label == NOISY), 0)
    yield "<h3>Side by side</h3>"
    yield html.comparison(pictures, left, ours[-1] if ours else len(pictures) - 1, views)

    for index, (y, x) in enumerate(corners):
        yield f"<h3>Detail {index + 1}, where the methods differ most</h3>"
        crops = (Picture(p.label, p.pixels[y : y + side, x : x + side]) for p in pictures)
        yield html.gallery(crops, "crops")

    yield "<h3>Where the error is</h3><p>Relative error of every pixel against the reference.</p>"
    maps = {label: _error_map(image, each.bench_set.reference) for label, image in images.items()}
    judged = [error for label, error in maps.items() if label != NOISY] or list(maps.values())
    if judged:
        # The median, so that one outlier does not turn the maps of all others black.
        most = float(np.sqrt(np.median([np.percentile(error, 99) for error in judged]))) or 1.0
        yield html.gallery(
            Picture(f"error of {label}", error_in_false_color(error, most)[0])
            for label, error in maps.items()
        )
        yield html.error_scale(most)


def _series(each: SetRows, label: str) -> str | None:
    return next((row.series for row in each.rows if row.label == label), None)


def _detail_side(picture: FloatImage) -> int:
    shorter: int = min(picture.shape[:2])
    return max(round(shorter * DETAIL_FRACTION), 1)


def _details(pictures: Sequence[FloatImage]) -> list[tuple[int, int]]:
    """Return the upper left corners (row, column) of squares in which the pictures differ most."""
    grey = np.stack(pictures).mean(axis=3)
    # Medians, so that one outlier does not choose the details.
    spread = np.median(np.abs(grey - np.median(grey, axis=0)), axis=0)
    side = _detail_side(pictures[0])
    sums = np.pad(spread.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    score = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    corners = []
    for _ in range(DETAILS):
        y, x = (int(i) for i in np.unravel_index(np.argmax(score), score.shape))
        corners.append((y, x))
        score[max(y - side, 0) : y + side + 1, max(x - side, 0) : x + side + 1] = -1
        if score.max() < 0:
            break
    return corners


def _error_map(image: FloatImage, reference: FloatImage) -> FloatImage:
    """Return the relative squared error of blocks of pixels; values that are not finite count as black."""
    finite = np.where(np.isfinite(image), image, np.float32(0))
    error = relative_squared_error(finite, reference).mean(axis=2, keepdims=True)
    return block_means(error, max(error.shape[1] // MAP_WIDTH_PX, 1)).astype(np.float32)
