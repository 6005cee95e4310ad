"""Estimates the error of a network's output without a reference, from its halves and pilots."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.relmse import RELMSE_EPSILON
from tungsten_dip.buffers.render_buffers import FloatArray, Halves, mean_of, variance_of_mean
from tungsten_dip.fit.candidates import Candidates

_CHUNK_PIXELS = 1 << 18
_BIAS = 2.4
"""What the squared bias is, about, to the geometric mean of the variance and the median squared difference of
the pilots from the result."""

_CONFIDENCE = 4.0
"""An estimate may lie so many standard errors above the error estimated from the halves."""

_SURE = 0.35
"""Relative standard error of an estimate up to which it is used."""

_OVERFLOW_BOUND = 1e30
"""Larger relative squared errors count as this large: their sums overflow."""


def estimate_error(candidates: Candidates, scale: float, denoised: Halves) -> FloatArray:
    """Estimate the squared error of f = (f_a + f_b) / 2 in each pixel, relative to f^2 + 0.01.

    ``candidates`` and ``scale`` are the evidence's, ``denoised`` the outputs f_a and f_b for one half each,
    shape (pixels, 3), of the same pixels and in the same units; 0.01 is in the renderer's.

    The error is the variance of f plus its squared bias. The variance is (f_a - f_b)^2 / 4 on average. The
    bias of a pixel cannot be measured. Pilots blur in different ways, so that they differ from f where there
    is something to blur; but some are far off where the network rightly avoids them, and there both outputs
    agree. The squared bias is estimated as `_BIAS` times the geometric mean of the variance and the median
    squared difference of f and the pilots, or less if the noisy halves imply a smaller error on average
    (`error_from_halves`).
    """
    output = mean_of(denoised)
    epsilon = epsilon_of_renderer(scale)
    squared = variance_of_mean(denoised)
    variance = np.empty(len(output), np.float32)
    bias_squared = np.empty(len(output), np.float32)
    computed = [(a.reshape(-1, 3), b.reshape(-1, 3)) for a, b in candidates.filtered]
    for first in range(0, len(output), _CHUNK_PIXELS):
        part = slice(first, first + _CHUNK_PIXELS)
        relative = 1 / (output[part] ** 2 + epsilon)
        with np.errstate(over="ignore"):
            apart = [
                channel_mean((mean_of((a[part], b[part])) - output[part]) ** 2 * relative)[:, 0]
                for a, b in computed
            ]
            variance[part] = np.minimum(channel_mean(squared[part] * relative)[:, 0], _OVERFLOW_BOUND)
            apart_squared = np.minimum(np.median(apart, axis=0), _OVERFLOW_BOUND)
        # The root of each: their product would overflow.
        bias_squared[part] = np.float32(_BIAS) * np.sqrt(variance[part]) * np.sqrt(apart_squared)
    estimated, standard_error = error_from_halves(candidates.noisy, denoised, epsilon)
    mean_variance, mean_bias_squared = (
        float(part.mean(dtype=np.float64)) for part in (variance, bias_squared)
    )
    allowed = max(estimated + _CONFIDENCE * standard_error - mean_variance, 0.0)
    return variance + bias_squared * np.float32(min(1.0, allowed / max(mean_bias_squared, 1e-30)))


def held_out_error(candidates: Candidates, denoised: Halves) -> float:
    """Return the average of that error over all pixels, estimated from the other half: unbiased, but noisy.

    Relative to f^2 + 0.01 in the units of the evidence, so that what is decided by it does not depend on the
    exposure. Estimated from the noisy halves or, where their standard error is too large, from the first
    pilot, far less noisy but a little blurred.
    """
    epsilon = np.float32(RELMSE_EPSILON)
    for targets in (candidates.noisy, candidates.pilots[0]):
        mean, standard_error = error_from_halves(targets, denoised, epsilon)
        if is_sure(mean, standard_error):
            break
    relative = 1 / (mean_of(denoised) ** 2 + epsilon)
    return max(mean, float((variance_of_mean(denoised) * relative).mean(dtype=np.float64)))


def error_from_halves(targets: Halves, denoised: Halves, epsilon: np.float32) -> tuple[float, float]:
    """Return the error of f = (f_a + f_b) / 2, relative to f^2 + ``epsilon``, and its standard error.

    It is the average over all pixels, by ``targets``: independent images of the truth, one for each half.
    """
    noisy_a, noisy_b = (image.reshape(-1, 3) for image in targets)
    error_of_one_half, variance = crossed_errors((noisy_a, noisy_b), denoised)
    error = error_of_one_half - variance
    return mean_and_standard_error(channel_mean(bounded_ratio(error, mean_of(denoised) ** 2 + epsilon)))


def crossed_errors(noisy: Halves, denoised: Halves) -> tuple[FloatArray, FloatArray]:
    """Return estimates of the squared error of one half's result, and of the variance of f = (f_a + f_b) / 2.

    ``noisy`` are independent images a, b of the truth, and ``denoised`` the results f_a, f_b of one of them
    each. The residuals f_a - a and f_b - b are independent, and the mean of each is the bias of a result.
    With var, the variance of f, which is half that of f_a or f_b,

        E[(f_a - a) (f_b - b)] = bias^2
        E[(f_a - f_b)^2 / 4] = var
        error of one half = bias^2 + 2 var
        error of f = bias^2 + var

    so that the error of f is the first estimate minus the second. Where float32 overflows, either may be
    infinite, and the first NaN.
    """
    (a, b), (denoised_a, denoised_b) = noisy, denoised
    with np.errstate(over="ignore", invalid="ignore"):
        variance = variance_of_mean(denoised)
        error_of_one_half = (denoised_a - a) * (denoised_b - b) + 2 * variance
    return error_of_one_half, variance


def mean_and_standard_error(values: FloatArray) -> tuple[float, float]:
    """Return the mean of independent values, and its standard error."""
    spread = float(values.std(dtype=np.float64))
    return float(values.mean(dtype=np.float64)), spread / math.sqrt(values.size)


def is_sure(mean: float, standard_error: float) -> bool:
    """Whether an unbiased estimate is precise enough to be used."""
    return standard_error < _SURE * mean


def bounded_ratio(
    squared: npt.NDArray[np.floating[Any]], denominator: npt.NDArray[np.floating[Any]]
) -> npt.NDArray[Any]:
    """Return squared errors relative to a denominator, bounded so that they can be summed."""
    with np.errstate(over="ignore"):
        return np.clip(squared / denominator, -_OVERFLOW_BOUND, _OVERFLOW_BOUND)


def epsilon_of_renderer(scale: float) -> np.float32:
    """0.01 in the renderer's units, squared differences of which are scaled twice; bounded for float32."""
    return np.float32(min(max(RELMSE_EPSILON * scale**2, 1e-30), 1e30))
