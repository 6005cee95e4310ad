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
from tungsten_dip.fit.preparation.exposure import BLACK

_RADIUS = 24
_STANDARD_ERRORS = 3.0
"""So many standard errors are subtracted from what is given back."""

_LARGEST_GAIN = 1.25

_LAMP = 16.0
"""Pixels more than so many times brighter than is typical around them are lamps or highlights."""


def gain_of_lost_light(noisy: Halves, image: FloatImage, threads: int) -> FloatImage:
    """Return what an image is to be multiplied by, shape (height, width, 1), from 1 to 1.25.

    ``noisy`` are the noisy halves, linear radiance in the units of `evidence.Evidence`, shape (height, width,
    3) like the image. The gain gives back what is missing from the image's mean over 49x49 pixels, as far as
    it is statistically certain. Lamps neither count nor gain, and no pixel may miss more than is typical
    around it (the geometric mean): what a lamp and its rim lost must not go to the dark around them.
    """

    def mean(values: FloatImage) -> FloatImage:
        return _core.box_mean(values, _RADIUS, threads)

    level = channel_mean(image)
    typical = np.exp(mean(np.log(level + np.float32(BLACK))))
    counted = level <= np.float32(_LAMP) * typical
    missing = np.clip(channel_mean(mean_of(noisy)) - level, -typical, typical) * counted
    variance = mean(channel_mean(variance_of_mean(noisy)) * counted)
    error = np.sqrt(np.maximum(variance, 0) / window_pixels(image.shape, _RADIUS))
    certain = np.maximum(mean(missing) - np.float32(_STANDARD_ERRORS) * error, 0)
    gain = 1 + certain / np.maximum(mean(level * counted), np.float32(1e-15))
    return np.where(counted, np.minimum(gain, np.float32(_LARGEST_GAIN)), np.float32(1))
