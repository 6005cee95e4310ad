"""Gives back light that the fit has lost over an area.

Where dark detail that no feature contains is as fine as a pixel (the shadow of leaves, print in a mirror),
the filters' means of bright pixels contain dark ones, and no candidate is bright enough.
"""

from __future__ import annotations

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.render_buffers import FloatImage, Halves, mean_of, variance_of_mean
from tungsten_dip.fit.neighbours import window_pixels

_RADIUS = 24
_STANDARD_ERRORS = 3.0
"""So many standard errors are subtracted from what is given back."""

_LARGEST_GAIN = 1.25


def gain_of_lost_light(noisy: Halves, image: FloatImage, unlit: FloatImage, threads: int) -> FloatImage:
    """Return what the image is to be multiplied by, shape (height, width, 1), from 1 to 1.25.

    ``noisy`` are the noisy halves, linear radiance like the image. The mean that is missing from it in the
    49x49 pixels around, as far as it is statistically certain, is relative to the image's own. Only pixels
    that are ``unlit`` (1, else 0; shape (height, width, 1)) count and gain: at the rims of lamps more is lost
    than their surroundings may get.
    """

    def total(values: FloatImage) -> FloatImage:
        return _core.box_mean(values * unlit, _RADIUS, threads) * window_pixels(image.shape, _RADIUS)

    missing = total(channel_mean(mean_of(noisy) - image))
    variance = np.maximum(total(channel_mean(variance_of_mean(noisy))), 0)
    certain = np.maximum(missing - np.float32(_STANDARD_ERRORS) * np.sqrt(variance), 0)
    gain = certain / np.maximum(total(channel_mean(image)), np.float32(1e-15))
    bounded: FloatImage = 1 + np.minimum(gain, np.float32(_LARGEST_GAIN - 1)) * unlit
    return bounded
