"""The report of one fit: a self-contained page with the images, the error, its history and the settings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.display import ldr_from_feature, ldr_from_radiance
from tungsten_dip.buffers.render_buffers import FEATURES, RenderBuffers
from tungsten_dip.buffers.sanitize import with_depth_ahead
from tungsten_dip.fit.result import FitResult, HistoryPoint
from tungsten_dip.fit.settings import PAPER_SETTINGS
from tungsten_dip.report import html
from tungsten_dip.report.html import Picture
from tungsten_dip.report.line_plot import Label, Point, line_plot
from tungsten_dip.report.preview import error_in_false_color
from tungsten_dip.scene.tonemap import display_from_radiance
from tungsten_dip.scene.types import TonemapName

_CURVE_HEIGHT = 260


def report_page(
    title: str,
    buffers: RenderBuffers,
    result: FitResult,
    lines: Sequence[str],
    tonemap: TonemapName = "gamma",
) -> str:
    """Return the page for one fit, its pictures displayed with one of Tungsten's tonemaps.

    ``lines`` are what was logged of the input and the fit: how layers were assigned, what was repaired, the
    notes of the result. What came again, such as with every preview, is shown once.
    """
    features = list(_features(buffers))
    pictures = [
        Picture("noisy", display_from_radiance(buffers.color.mean, tonemap)),
        Picture("denoised", display_from_radiance(result.color, tonemap)),
        *features,
    ]
    notes = list(dict.fromkeys(lines))
    body = [
        html.figures(_figures(result)),
        html.comparison(pictures, left=0, right=1),
        *_error_map(result),
        *_curve(result.history),
        *(("<h2>Guided by</h2>", html.gallery(features)) if features else ()),
        "<h2>Settings</h2>",
        html.facts(_settings(result)),
        "<h2>Notes</h2>",
        html.bullets(notes) if notes else "<p>Nothing was missing and nothing was repaired.</p>",
    ]
    return html.page(title, _subtitle(buffers), body)


def _features(buffers: RenderBuffers) -> Iterator[Picture]:
    """Yield the means of the features for the eye: albedo with a gamma, depth up to its 99th percentile.

    The depth of the sky, which other renderers mark by a large number, is 0 as in Tungsten's.
    """
    for name, buffer in buffers.quantities():
        if name == "color":
            continue
        values = np.nan_to_num((with_depth_ahead(buffer) if name == "depth" else buffer).mean)
        if name == "depth":
            values = np.where(values < _core.INFINITE_DEPTH, values, np.float32(0))
            values = np.minimum(values, np.float32(np.percentile(values, 99) or np.inf))
        ldr = ldr_from_radiance(values) if name == "albedo" else ldr_from_feature(name, values)
        yield Picture(name, np.ascontiguousarray(np.broadcast_to(ldr, (*values.shape[:2], 3))))


def _subtitle(buffers: RenderBuffers) -> str:
    size = f"{buffers.width} x {buffers.height} pixels"
    spp = "" if buffers.spp is None else f", {float(np.mean(buffers.spp)):g} samples per pixel"
    features = [name for name, _ in buffers.quantities() if name in FEATURES]
    return f"{size}{spp}, guided by {', '.join(features) or 'the colour only'}"


def _figures(result: FitResult) -> Iterable[tuple[str, str]]:
    yield "time", f"{result.seconds:.1f} s"
    yield "iterations", str(result.iterations)
    if result.estimated_relmse is not None:
        yield "estimated relMSE", f"{result.estimated_relmse:.3g}"


def _settings(result: FitResult) -> Iterator[tuple[str, str]]:
    for name, value in asdict(result.settings).items():
        if value is None or (name in PAPER_SETTINGS and result.settings.preset != "paper"):
            continue
        yield name.replace("_", " "), ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _error_map(result: FitResult) -> Iterator[str]:
    if result.error is None:
        return
    picture, most = error_in_false_color(result.error)
    yield "<h2>Where the error is</h2><p>The estimated relative error of every pixel.</p>"
    yield f'<img alt="estimated error" src="{html.data_uri(picture)}">'
    yield html.error_scale(most)


def _curve(history: Sequence[HistoryPoint]) -> Iterator[str]:
    """Yield the estimated relMSE over seconds as an SVG, its axis logarithmic, if there is a line to draw."""
    # Where no error is left to see, its estimate is 0, which a logarithm cannot show.
    known = [(p, relmse) for p in history if (relmse := p.estimated_relmse) is not None and relmse > 0]
    if len(known) < 2:
        return
    end_s = max(known[-1][0].seconds, 1e-9)
    ticks = _round_ticks(min(relmse for _, relmse in known), max(relmse for _, relmse in known))
    bottom, top = math.log10(ticks[0]), math.log10(ticks[-1])

    def y(relmse: float) -> float:
        return (math.log10(relmse) - bottom) / (top - bottom)

    points = [
        Point(
            point.seconds / end_s,
            y(relmse),
            f"{point.seconds:.1f} s, iteration {point.iteration}: relMSE {relmse:.3g}",
        )
        for point, relmse in known
    ]
    step_s = _round_step(end_s / 6)
    times = [count * step_s for count in range(int(end_s / step_s) + 1)]
    plot = line_plot(
        "Estimated relMSE over seconds",
        points,
        below=[Label(time_s / end_s, f"{time_s:g} s") for time_s in times],
        beside=[Label(y(tick), f"{tick:g}") for tick in ticks],
        height=_CURVE_HEIGHT,
    )
    yield f"<h2>Error over time</h2><p>Estimated relMSE, logarithmic.</p>{plot}"


def _round_ticks(low: float, high: float) -> list[float]:
    """Return 1, 2 and 5 times powers of ten, or only the powers if there are many, enclosing a range."""
    exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 2)
    digits = (1, 2, 5) if len(exponents) <= 4 else (1,)
    ticks = [float(f"{digit}e{exponent}") for exponent in exponents for digit in digits]
    first = max(index for index, tick in enumerate(ticks) if tick <= low * (1 + 1e-9))
    last = min(index for index, tick in enumerate(ticks) if tick >= high * (1 - 1e-9))
    return ticks[first : max(last, first + 1) + 1]


def _round_step(least: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is no less."""
    power: float = 10.0 ** math.floor(math.log10(max(least, 1e-6)))
    return next(step for step in (power, 2 * power, 5 * power, 10 * power) if step >= least)
