"""Makes the denoised image of a network's output, unless the input is as good."""

from __future__ import annotations

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.relmse import RELMSE_EPSILON
from tungsten_dip.buffers.render_buffers import (
    FloatImage,
    Halves,
    RenderBuffers,
    mean_of,
    variance_of_mean,
)
from tungsten_dip.fit.evidence import Evidence
from tungsten_dip.fit.output.all_samples import with_all_samples
from tungsten_dip.fit.output.lost_detail import with_lost_detail
from tungsten_dip.fit.output.lost_light import gain_of_lost_light
from tungsten_dip.fit.output.unseen_light import without_unseen_light
from tungsten_dip.fit.preparation.exposure import exposure, unscaled
from tungsten_dip.fit.result import DenoisedImage
from tungsten_dip.fit.scoring.estimate import (
    bounded_ratio,
    epsilon_of_renderer,
    error_from_halves,
    estimate_error,
)

_ERROR_RADIUS = 4
_CONVERGED = 1e-5
"""relMSE of an image that nothing can improve: noise of 0.3% of the radiance."""


def image_without_noise(buffers: RenderBuffers, threads: int) -> DenoisedImage | None:
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
    bright = squared + RELMSE_EPSILON / exposure(color) ** 2
    estimated = [float(np.mean(n / bright)) for n in (noise, color.variance) if n is not None]
    if max(estimated) >= _CONVERGED or (estimated == [0] and not black):
        return None
    why = "no pixel has any light" if black else "the halves agree to within a few thousandths"
    error = channel_mean(bounded_ratio(noise, squared + RELMSE_EPSILON).astype(np.float32))
    return DenoisedImage(
        color=color.mean.copy(),
        halves=(a.copy(), b.copy()),
        error=_core.box_mean(error, _ERROR_RADIUS, threads),
        estimated_relmse=float(error.mean(dtype=np.float64)),
        notes=(f"{why}: the image is returned as it is",),
    )


def denoised_image(
    evidence: Evidence, denoised: Halves, all_samples_blend: FloatImage | None
) -> DenoisedImage:
    """Make the image from the network's outputs for both halves, or from the input if that is as good.

    ``all_samples_blend`` are the pilots of all samples, blended with the mean of both halves' weights; it
    gets the same detail back as the halves' blends.
    """
    threads, noisy = evidence.threads, evidence.candidates.noisy
    blended = mean_of(denoised)
    denoised = with_lost_detail(noisy, denoised, evidence.halves_drawn)
    image = mean_of(denoised)
    if all_samples_blend is not None:
        # What the halves' blends lost, that of all samples lost with the same weights.
        with_detail = np.maximum(all_samples_blend + (image - blended), 0)
        image = with_all_samples(denoised, with_detail, threads)
    if evidence.light is not None:
        denoised, image = without_unseen_light(noisy, denoised, image, evidence.light, threads)
    if not evidence.halves_drawn:
        light = gain_of_lost_light(noisy, mean_of(denoised), threads)
        light_of_all = light if all_samples_blend is None else gain_of_lost_light(noisy, image, threads)
        image = image * light_of_all
        denoised = denoised[0] * light, denoised[1] * light
    pixels = denoised[0].reshape(-1, 3), denoised[1].reshape(-1, 3)
    error = estimate_error(evidence.candidates, evidence.scale, pixels).reshape(*image.shape[:2], 1)

    # The error of the plain mean, by the same evidence.
    squared = variance_of_mean(noisy)
    denominator = mean_of(denoised) ** 2 + np.float32(RELMSE_EPSILON)
    error_of_input = float((squared / denominator).mean(dtype=np.float64))
    estimated, _ = error_from_halves(noisy, pixels, np.float32(RELMSE_EPSILON))
    notes = evidence.notes
    if estimated >= error_of_input:
        without = "" if evidence.gain is None else " without its fireflies"
        notes = (*notes, f"the input{without} is as good as anything fitted to it, and is returned")
        image, denoised = evidence.mean, noisy
        epsilon = epsilon_of_renderer(evidence.scale)
        error = bounded_ratio(squared, image**2 + epsilon).mean(axis=2, keepdims=True)
    if evidence.gain is not None:
        image = image * evidence.gain
    return DenoisedImage(
        color=unscaled(image, evidence.scale),
        halves=(unscaled(denoised[0], evidence.scale), unscaled(denoised[1], evidence.scale)),
        error=_core.box_mean(error, _ERROR_RADIUS, threads),
        estimated_relmse=float(error.mean(dtype=np.float64)),
        gain=evidence.gain,
        notes=notes,
    )
