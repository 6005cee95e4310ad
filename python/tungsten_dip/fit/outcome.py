"""Makes the result from a network's output: the image, its error, and whether it is better than the input."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.model import FloatArray, FloatImage, Halves, RenderBuffers
from tungsten_dip.buffers.relmse import RELMSE_EPSILON
from tungsten_dip.cores import thread_count
from tungsten_dip.fit.all_samples import with_all_samples
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.evidence import Evidence
from tungsten_dip.fit.exposure import exposure, unscaled
from tungsten_dip.fit.lost_detail import with_lost_detail
from tungsten_dip.fit.result import FitResult, HistoryPoint
from tungsten_dip.fit.settings import FitSettings

_ERROR_RADIUS = 4
_CHUNK_PIXELS = 1 << 18
_BIAS = 2.4
"""What the squared bias is, about, to the geometric mean of the variance and the median squared difference of
the pilots from the result."""

_CONFIDENCE = 4.0
"""An estimate may lie so many standard errors above the error estimated from the halves."""

_SURE = 0.35
"""Relative standard error of an estimated relMSE up to which it is used."""

_LARGEST_ERROR = 1e30
"""Larger relative squared errors count as this large: their sums overflow."""

_CONVERGED = 1e-5
"""relMSE of an image that nothing can improve: noise of 0.3% of the radiance."""


def result_without_noise(buffers: RenderBuffers, settings: FitSettings, clock: Clock) -> FitResult | None:
    """Return the image as it is if its halves hardly differ, else None.

    Copies do not differ at all: they count as free of noise only if the variance confirms it.
    """
    color = buffers.color
    if color.halves is None:
        return None
    a, b = color.halves
    squared = color.mean.astype(np.float64) ** 2
    noise = (a - b).astype(np.float64) ** 2 / 4
    # Dark images are not mistaken for clean ones.
    bright = squared + RELMSE_EPSILON / exposure(color.mean) ** 2
    estimated = [float(np.mean(n / bright)) for n in (noise, color.variance) if n is not None]
    if max(estimated) >= _CONVERGED or estimated == [0]:
        return None
    relative = np.minimum(noise / (squared + RELMSE_EPSILON), _LARGEST_ERROR)
    error = channel_mean(relative.astype(np.float32))
    return FitResult(
        color=color.mean.copy(),
        settings=settings,
        seconds=clock.seconds(),
        iterations=0,
        error=_core.box_mean(error, _ERROR_RADIUS, thread_count(settings.threads)),
        estimated_relmse=float(error.mean(dtype=np.float64)),
        halves=color.halves,
        notes=("the halves agree to within a few thousandths: the image is returned as it is",),
    )


def estimate_error(
    pilots: Sequence[Halves], scale: float, fused_a: FloatArray, fused_b: FloatArray
) -> FloatArray:
    """Estimate the squared error of f = (fused_a + fused_b) / 2 in each pixel, relative to f^2 + 0.01.

    ``pilots`` and ``scale`` are the evidence's, ``fused_a`` and ``fused_b`` outputs for one half each, shape
    (pixels, 3), of the same pixels and in the same units; 0.01 is in the renderer's. The variance of f is
    (fused_a - fused_b)^2 / 4 in the mean. Its bias cannot be measured. Pilots blur in different ways, so that
    they differ from f where there is something to blur; but some are far off where the network rightly
    avoids them, and there both outputs agree. The squared bias is estimated as `_BIAS` times the geometric
    mean of the variance and the median squared difference of f and the pilots, or less if the noisy halves
    imply a smaller mean error (see `_error_from_halves`).
    """
    output = np.float32(0.5) * (fused_a + fused_b)
    epsilon = _epsilon_of_renderer(scale)
    squared = (fused_a - fused_b) ** 2 / 4
    variance = np.empty(len(output), np.float32)
    bias = np.empty(len(output), np.float32)
    computed = [(a.reshape(-1, 3), b.reshape(-1, 3)) for a, b in pilots[1:]]
    for first in range(0, len(output), _CHUNK_PIXELS):
        part = slice(first, first + _CHUNK_PIXELS)
        relative = 1 / (output[part] ** 2 + epsilon)
        with np.errstate(over="ignore"):
            apart = [
                channel_mean((np.float32(0.5) * (a[part] + b[part]) - output[part]) ** 2 * relative)[:, 0]
                for a, b in computed
            ]
            variance[part] = np.minimum(channel_mean(squared[part] * relative)[:, 0], _LARGEST_ERROR)
            apart_squared = np.minimum(np.median(apart, axis=0), _LARGEST_ERROR)
        # The root of each: their product would overflow.
        bias[part] = np.float32(_BIAS) * np.sqrt(variance[part]) * np.sqrt(apart_squared)
    estimated, standard_error = _error_from_halves(pilots[0], fused_a, fused_b, epsilon)
    least, mean_bias = (float(part.mean(dtype=np.float64)) for part in (variance, bias))
    allowed = max(estimated + _CONFIDENCE * standard_error - least, 0.0)
    return variance + bias * np.float32(min(1.0, allowed / max(mean_bias, 1e-30)))


def _epsilon_of_renderer(scale: float) -> np.float32:
    """0.01 in the renderer's units, squared differences of which are scaled twice; bounded for float32."""
    return np.float32(min(max(RELMSE_EPSILON * scale**2, 1e-30), 1e30))


def _relative(squared: FloatArray, denominator: FloatArray) -> FloatArray:
    with np.errstate(over="ignore"):
        relative: FloatArray = np.clip(squared / denominator, -_LARGEST_ERROR, _LARGEST_ERROR)
    return relative


def held_out_error(pilots: Sequence[Halves], fused_a: FloatArray, fused_b: FloatArray) -> float:
    """Return the mean of the same error, estimated from the other half: unbiased, but noisy.

    Relative to f^2 + 0.01 in the units of the evidence, so that what is decided by it does not depend on the
    exposure. Estimated from the noisy halves or, where their standard error is too large, from the smallest
    pilot, far less noisy but a little blurred.
    """
    epsilon = np.float32(RELMSE_EPSILON)
    for targets in pilots[:2]:
        mean, standard_error = _error_from_halves(targets, fused_a, fused_b, epsilon)
        if standard_error < _SURE * mean:
            break
    relative = 1 / ((np.float32(0.5) * (fused_a + fused_b)) ** 2 + epsilon)
    return max(mean, float(((fused_a - fused_b) ** 2 / 4 * relative).mean(dtype=np.float64)))


def _error_from_halves(
    targets: Halves, fused_a: FloatArray, fused_b: FloatArray, epsilon: np.float32
) -> tuple[float, float]:
    """Return the mean error estimated from independent targets, and its standard error.

    With targets a, b (noisy images of the truth) and outputs f_a, f_b for one half each, E (f_a - b)^2 is the
    error of f_a plus the noise of b, E (a - b)^2 the noise of both, and E (f_a - f_b)^2 / 2 the variance of
    one output; the mean of two has half of that.
    """
    a, b = (image.reshape(-1, 3) for image in targets)
    crossed = ((fused_a - b) ** 2 + (fused_b - a) ** 2 - (a - b) ** 2) / 2 - (fused_a - fused_b) ** 2 / 4
    error = channel_mean(_relative(crossed, (np.float32(0.5) * (fused_a + fused_b)) ** 2 + epsilon))
    spread = float(error.std(dtype=np.float64))
    return float(error.mean(dtype=np.float64)), spread / math.sqrt(error.size)


def result_from_fused(
    evidence: Evidence,
    fused: Halves,
    whole: FloatImage | None,
    settings: FitSettings,
    clock: Clock,
    iterations: int,
    history: Sequence[HistoryPoint],
    notes: Sequence[str],
) -> FitResult:
    """Make the result from the network's outputs for both halves, or from the input if that is as good.

    ``whole`` are the pilots of all samples, blended with the mean of both halves' weights.
    """
    threads = evidence.threads
    shape = fused[0].shape
    fused = with_lost_detail(evidence.halves, fused)
    fused_a, fused_b = (half.reshape(-1, 3) for half in fused)
    image = np.float32(0.5) * (fused[0] + fused[1])
    if whole is not None:
        image = with_all_samples(fused, whole, threads)
    error = estimate_error(evidence.pilots, evidence.scale, fused_a, fused_b).reshape(*shape[:2], 1)

    # The error of the plain mean, by the same evidence.
    half_a, half_b = evidence.halves
    squared: FloatArray = np.float32(0.25) * (half_a - half_b) ** 2
    error_of_input = float((squared / (image**2 + np.float32(RELMSE_EPSILON))).mean(dtype=np.float64))
    notes = [*evidence.notes, *notes]
    estimated, _ = _error_from_halves(evidence.halves, fused_a, fused_b, np.float32(RELMSE_EPSILON))
    if estimated >= error_of_input:
        notes.append("the input is as good as anything fitted to it, and is returned")
        image, fused = evidence.mean, evidence.halves
        epsilon = _epsilon_of_renderer(evidence.scale)
        error = _relative(squared, image**2 + epsilon).mean(axis=2, keepdims=True)
    if evidence.gain is not None:
        image = image * evidence.gain
    return FitResult(
        color=unscaled(image, evidence.scale),
        settings=settings,
        seconds=clock.seconds(),
        iterations=iterations,
        error=_core.box_mean(error, _ERROR_RADIUS, threads),
        estimated_relmse=float(error.mean(dtype=np.float64)),
        halves=(unscaled(fused[0], evidence.scale), unscaled(fused[1], evidence.scale)),
        gain=evidence.gain,
        history=tuple(history),
        notes=tuple(notes),
    )
