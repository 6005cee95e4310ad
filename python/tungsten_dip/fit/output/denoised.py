"""Makes the denoised image of a network's output, unless the input is as good."""

from __future__ import annotations

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.relmse import RELMSE_EPSILON
from tungsten_dip.buffers.render_buffers import FloatArray, FloatImage, Halves, RenderBuffers, mean_of
from tungsten_dip.cores import thread_count
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.evidence import Evidence
from tungsten_dip.fit.output.all_samples import with_all_samples
from tungsten_dip.fit.output.error import (
    bounded_ratio,
    epsilon_of_renderer,
    error_from_halves,
    estimate_error,
)
from tungsten_dip.fit.output.lost_detail import with_lost_detail
from tungsten_dip.fit.preparation.exposure import exposure, unscaled
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.progress import Progress

_ERROR_RADIUS = 4
_CONVERGED = 1e-5
"""relMSE of an image that nothing can improve: noise of 0.3% of the radiance."""


def result_without_noise(
    buffers: RenderBuffers, settings: FitSettings, clock: Clock, progress: Progress
) -> FitResult | None:
    """Return the image as it is if its halves hardly differ or it is black, else None.

    Copies do not differ at all: they count as free of noise only if the variance confirms it.
    """
    color = buffers.color
    squared = color.mean.astype(np.float64) ** 2
    black = not squared.any()
    if color.halves is None and not black:
        return None
    a, b = color.halves_or_mean
    noise = (a - b).astype(np.float64) ** 2 / 4
    # Dark images are not mistaken for clean ones.
    bright = squared + RELMSE_EPSILON / exposure(color.mean) ** 2
    estimated = [float(np.mean(n / bright)) for n in (noise, color.variance) if n is not None]
    if max(estimated) >= _CONVERGED or (estimated == [0] and not black):
        return None
    progress(1.0, "no noise")
    why = "no pixel has any light" if black else "the halves agree to within a few thousandths"
    error = channel_mean(bounded_ratio(noise, squared + RELMSE_EPSILON).astype(np.float32))
    return FitResult(
        color=color.mean.copy(),
        settings=settings,
        seconds=clock.seconds(),
        iterations=0,
        error=_core.box_mean(error, _ERROR_RADIUS, thread_count(settings.threads)),
        estimated_relmse=float(error.mean(dtype=np.float64)),
        halves=(a.copy(), b.copy()),
        notes=(f"{why}: the image is returned as it is",),
    )


def denoised_image(
    evidence: Evidence,
    denoised: Halves,
    all_samples_blend: FloatImage | None,
    settings: FitSettings,
    clock: Clock,
) -> FitResult:
    """Make the image from the network's outputs for both halves, or from the input if that is as good.

    ``all_samples_blend`` are the pilots of all samples, blended with the mean of both halves' weights; it
    gets the same detail back as the halves' blends. The result is that of a network without training
    (``iterations`` 0), and without its ``model``.
    """
    threads = evidence.threads
    blended = mean_of(denoised)
    denoised = with_lost_detail(evidence.halves, denoised, evidence.halves_drawn)
    image = mean_of(denoised)
    if all_samples_blend is not None:
        # What the halves' blends lost, that of all samples lost with the same weights.
        with_detail = np.maximum(all_samples_blend + (image - blended), 0)
        image = with_all_samples(denoised, with_detail, threads)
    pixels = denoised[0].reshape(-1, 3), denoised[1].reshape(-1, 3)
    error = estimate_error(evidence.candidates, evidence.scale, pixels).reshape(*image.shape[:2], 1)

    # The error of the plain mean, by the same evidence.
    half_a, half_b = evidence.halves
    squared: FloatArray = np.float32(0.25) * (half_a - half_b) ** 2
    denominator = mean_of(denoised) ** 2 + np.float32(RELMSE_EPSILON)
    error_of_input = float((squared / denominator).mean(dtype=np.float64))
    estimated, _ = error_from_halves(evidence.halves, pixels, np.float32(RELMSE_EPSILON))
    notes = evidence.notes
    if estimated >= error_of_input:
        without = "" if evidence.gain is None else " without its fireflies"
        notes = (*notes, f"the input{without} is as good as anything fitted to it, and is returned")
        image, denoised = evidence.mean, evidence.halves
        epsilon = epsilon_of_renderer(evidence.scale)
        error = bounded_ratio(squared, image**2 + epsilon).mean(axis=2, keepdims=True)
    if evidence.gain is not None:
        image = image * evidence.gain
    return FitResult(
        color=unscaled(image, evidence.scale),
        settings=settings,
        seconds=clock.seconds(),
        iterations=0,
        error=_core.box_mean(error, _ERROR_RADIUS, threads),
        estimated_relmse=float(error.mean(dtype=np.float64)),
        halves=(unscaled(denoised[0], evidence.scale), unscaled(denoised[1], evidence.scale)),
        gain=evidence.gain,
        halves_drawn=evidence.halves_drawn,
        notes=notes,
    )
