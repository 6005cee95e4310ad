"""Images whose halves cannot score anything: there are none, or their noise is not independent."""

from __future__ import annotations

import time

import numpy as np

from tungsten_dip.buffers.model import Buffer, RenderBuffers
from tungsten_dip.buffers.statistics import HalvesTest, halves_independent
from tungsten_dip.cores import thread_count
from tungsten_dip.fit.evidence import (
    exposure,
    notes_on_features,
    oidn_mean,
    scaled,
    scaled_variance,
    unscaled,
)
from tungsten_dip.fit.fireflies import limit_fireflies_alone
from tungsten_dip.fit.pilots import Pilot, PilotMaker, first_guides, guidance_of_halves
from tungsten_dip.fit.settings import RELMSE_EPSILON, FitResult, FitSettings, HistoryPoint
from tungsten_dip.progress import Progress

_PILOTS = (
    Pilot(9, k=1.0),
    Pilot(10, k=2.0, step=2, with_position=True),
    Pilot(4, k=1.0, by_color=True),
)
"""Of these the image is made where nothing can score them. The last, of the colour alone, keeps what no
feature shows, and outliers."""

_SHARES = (0.4, 0.4, 0.2)
"""Of the pilots in the image."""

_OUTLIER = 4.0
_OUTLIER_OFFSET = 0.02
"""Brighter than so many times the first pilot and this much more, the last one shows an outlier."""

_UNEQUAL = 0.5
"""Halves of one and two samples are so far apart from the mean of all three, in units of half their
difference, with room to spare."""

_ROUNDED = 2e-3
"""Relative difference that rounding to 16 bits explains."""

_CONVERGED = 1e-5
"""relMSE of an image that nothing can improve: noise of 0.3% of the radiance."""


def result_without_halves(
    buffers: RenderBuffers, settings: FitSettings, started: float, progress: Progress, *, offered: bool
) -> FitResult | None:
    """Return what is made of sanitised buffers whose halves tell nothing, None where they do.

    That is a mean of what three pilots make of all samples or, if the settings ask for it, Open Image
    Denoise; an image without noise comes back as it is. ``started`` is a value of time.perf_counter;
    ``offered``: there are candidates, of which a note says that they are not used.
    """
    color = buffers.color
    scale = exposure(color.mean)
    test = halves_independent(buffers, settings.threads)
    if test.independent and _halves_belong(color):
        return None
    if _converged(color, scale):
        notes = ["the halves agree to within a few thousandths: the image is returned as it is"]
        image, message = color.mean.copy(), "no noise"
    else:
        notes = [_why_no_halves(buffers, test, settings.pilot)]
        if offered:
            notes.append("the candidates are not used: nothing can score them")
        if settings.pilot == "oidn":
            image, message = oidn_mean(buffers, color.mean, settings.threads), "Open Image Denoise"
        else:
            notes = [*notes_on_features(buffers), *notes]
            threads = thread_count(settings.threads)
            emitted = np.zeros_like(color.mean)
            if buffers.albedo is not None:
                emitted = np.clip(buffers.albedo.mean - 1, 0, color.mean)
            rest, fireflies = limit_fireflies_alone(scaled(color.mean - emitted, scale), threads)
            if fireflies is not None:
                notes.append(fireflies)
            colors = (rest + scaled(emitted, scale),)
            variance = scaled_variance(color, scale)
            guidance = guidance_of_halves(buffers, colors, scale, threads)
            progress(0.2, "features")
            guides = first_guides(colors, variance, guidance)
            maker = PilotMaker(colors, variance, guidance, guides)
            # In images as small as a window of them, the others say nothing of their own.
            small = max(buffers.width, buffers.height) <= 2 * _PILOTS[1].radius
            first, *others = (maker.images(pilot)[0] for pilot in _PILOTS[: 1 if small else None])
            image, message = first, "one pilot"
            if others:
                others[-1] = np.minimum(others[-1], _OUTLIER * first + np.float32(_OUTLIER_OFFSET))
                image = np.tensordot(np.array(_SHARES, np.float32), np.stack((first, *others)), 1)
                message = "three pilots"
            image = unscaled(image, scale)
    seconds = time.perf_counter() - started
    progress(1.0, message)
    history = (HistoryPoint(seconds, 0, None),)
    return FitResult(image, settings, seconds, iterations=0, history=history, notes=tuple(notes))


def _converged(color: Buffer, scale: float) -> bool:
    """Whether halves differ (copies do not) by less than lets a test tell if their noise is independent."""
    if color.halves is None:
        return False
    a, b = color.halves
    squared = color.mean.astype(np.float64) ** 2 + RELMSE_EPSILON / scale**2
    noise = float(np.mean((a - b).astype(np.float64) ** 2 / 4 / squared))
    sampled = 0.0 if color.variance is None else float(np.mean(color.variance / squared))
    return 0 < noise < _CONVERGED and sampled < _CONVERGED


def _halves_belong(color: Buffer) -> bool:
    """Whether the colour is the mean of its halves, but for rounding and for halves of unequal size."""
    a, b = (half.astype(np.float64) for half in color.halves_or_mean)
    apart = np.median(abs((a + b) / 2 - color.mean))
    noise, level = np.median(abs(a - b) / 2), np.median(abs(color.mean))
    return bool(apart <= _UNEQUAL * noise + _ROUNDED * level)


def _why_no_halves(buffers: RenderBuffers, test: HalvesTest, pilot: str) -> str:
    used = "the image is that of Open Image Denoise" if pilot == "oidn" else "a mean of pilots is used"
    tail = f"nothing can score the result: {used}, without an estimate of its error"
    if buffers.color.halves is None:
        return f"no half buffers: {tail}"
    if test.independent:
        return f"the half buffers are those of another picture than the colour: {tail}"
    if not np.isfinite(test.correlation):
        return f"the image is too small or too plain to tell whether its halves are independent: {tail}"
    return f"the half buffers are not independent (correlation {test.correlation:.2f}): {tail}"
