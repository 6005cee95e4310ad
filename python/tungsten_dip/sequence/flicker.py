"""Flicker: what changes from frame to frame in the result, but not in the truth.

Both measures are relative squared errors of the temporal difference, like relMSE of a single image:
mean((D f - D r)^2 / ((f_t^2 + f_{t-1}^2) / 2 + 0.01)), with D f = f_t - f_{t-1} at the same pixel, f the
result and r the truth. What moves in the truth moves in r as well, so that motion is no flicker.
"""

from __future__ import annotations

import numpy as np

from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.relmse import RELMSE_EPSILON
from tungsten_dip.buffers.render_buffers import FloatImage, Halves, mean_of
from tungsten_dip.fit.scoring.estimate import crossed_errors, is_sure, mean_and_standard_error


def flicker(
    frame: FloatImage, previous: FloatImage, reference: FloatImage, previous_reference: FloatImage
) -> float:
    """Return the flicker of a frame against the one before, by the references of both.

    Images are linear radiance of one shape (height, width, 3); the denominator is that of the references.
    """
    error = (frame - previous) - (reference - previous_reference)
    return float(np.mean(error.astype(np.float64) ** 2 / _denominator(reference, previous_reference)))


def estimated_flicker(denoised: Halves, previous: Halves, noisy: Halves, previous_noisy: Halves) -> float:
    """Return the flicker without a reference, from halves A and B of both frames.

    ``denoised`` and ``previous`` are what was made of the halves ``noisy`` and ``previous_noisy``, each of
    its own half alone, through all frames. The change from frame to frame of one half's result is then
    independent of the noise of the other half's change, and the error of the change is estimated as that of
    an image (`crossed_errors`).

    Without bias, but with the noise of the input in it: where that is too large, the variance of the result's
    change is returned. It is the part of the flicker that is noise, and lacks what the results of both halves
    have in common.
    """
    d_denoised, d_noisy = _change(denoised, previous), _change(noisy, previous_noisy)
    with np.errstate(over="ignore", invalid="ignore"):
        denominator = _denominator(mean_of(denoised), mean_of(previous))
        error_of_one_half, variance = (
            channel_mean(error / denominator) for error in crossed_errors(d_noisy, d_denoised)
        )
        mean, standard_error = mean_and_standard_error(error_of_one_half - variance)
    return mean if is_sure(mean, standard_error) else float(variance.mean(dtype=np.float64))


def _change(halves: Halves, previous: Halves) -> Halves:
    return halves[0] - previous[0], halves[1] - previous[1]


def _denominator(image: FloatImage, previous: FloatImage) -> FloatImage:
    level: FloatImage = np.float32(0.5) * (image**2 + previous**2) + np.float32(RELMSE_EPSILON)
    return level
