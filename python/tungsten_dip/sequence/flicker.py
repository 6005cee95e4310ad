"""Flicker: what changes from frame to frame in the result, but not in the truth.

Both measures are relative squared errors of the temporal difference, like relMSE of a single image:
mean((D f - D r)^2 / ((f_t^2 + f_{t-1}^2) / 2 + 0.01)), with D f = f_t - f_{t-1} at the same pixel, f the
result and r the truth. What moves in the truth moves in r as well, so that motion is no flicker.
"""

from __future__ import annotations

import math

import numpy as np

from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.model import FloatImage, Halves
from tungsten_dip.buffers.relmse import RELMSE_EPSILON

_SURE = 0.35
"""Relative standard error up to which the unbiased estimate is believed."""


def flicker(
    frame: FloatImage, previous: FloatImage, reference: FloatImage, previous_reference: FloatImage
) -> float:
    """Return the flicker of a frame against the one before, by the references of both.

    Images are linear radiance of one shape (height, width, 3); the denominator is that of the references.
    """
    error = (frame - previous) - (reference - previous_reference)
    return float(np.mean(error.astype(np.float64) ** 2 / _denominator(reference, previous_reference)))


def estimated_flicker(fused: Halves, previous: Halves, noisy: Halves, previous_noisy: Halves) -> float:
    """Return the flicker without a reference, from halves A and B of both frames.

    ``fused`` and ``previous`` are what was made of the halves ``noisy`` and ``previous_noisy`` (a, b), each
    of its own half alone, through all frames. Then D f_a is independent of the noise of D b, and with D r the
    change of the truth

        E (D f_a - D b)^2 = E (D f_a - D r)^2 + Var D b,      E (D a - D b)^2 = Var D a + Var D b,

    so that ((D f_a - D b)^2 + (D f_b - D a)^2 - (D a - D b)^2) / 2 is in the mean the flicker of one half's
    result. Of f = (f_a + f_b) / 2 it is less by (D f_a - D f_b)^2 / 4, since
    ((x + y) / 2)^2 = (x^2 + y^2) / 2 - ((x - y) / 2)^2 holds for any x and y.

    Without bias, but with the noise of the input in it: where its standard error is above a third of it,
    E (D f_a - D f_b)^2 / 4 is returned, the variance of D f. It is the part of the flicker that is noise, and
    lacks what the results of both halves have in common.
    """
    d_fused_a, d_fused_b = fused[0] - previous[0], fused[1] - previous[1]
    d_a, d_b = noisy[0] - previous_noisy[0], noisy[1] - previous_noisy[1]
    denominator = _denominator(_mean(fused), _mean(previous))
    spread = channel_mean((d_fused_a - d_fused_b) ** 2 / 4 / denominator)
    crossed = (d_fused_a - d_b) ** 2 + (d_fused_b - d_a) ** 2 - (d_a - d_b) ** 2
    unbiased = channel_mean(crossed / 2 / denominator) - spread
    mean = float(unbiased.mean(dtype=np.float64))
    if float(unbiased.std(dtype=np.float64)) < _SURE * mean * math.sqrt(unbiased.size):
        return mean
    return float(spread.mean(dtype=np.float64))


def _mean(halves: Halves) -> FloatImage:
    mean: FloatImage = np.float32(0.5) * (halves[0] + halves[1])
    return mean


def _denominator(image: FloatImage, previous: FloatImage) -> FloatImage:
    level: FloatImage = np.float32(0.5) * (image**2 + previous**2) + np.float32(RELMSE_EPSILON)
    return level
