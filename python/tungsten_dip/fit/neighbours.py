"""The pixels around a pixel: how many there are, their mean without the pixel itself, and the largest."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tungsten_dip import _core
from tungsten_dip.buffers.render_buffers import FloatImage


def window_pixels(shape: tuple[int, ...], radius: int) -> FloatImage:
    """Return how many pixels of an image the window around each of them covers, shape (height, width, 1)."""
    rows, columns = (
        np.minimum(np.arange(n) + radius, n - 1) - np.maximum(np.arange(n) - radius, 0) + 1 for n in shape[:2]
    )
    count: FloatImage = np.outer(rows, columns).astype(np.float32)[..., None]
    return count


def mean_around(image: FloatImage, radius: int, threads: int) -> FloatImage:
    """Return the mean of the (2 radius + 1)^2 pixels around each, without it (0 where there is no other).

    ``image`` has shape (height, width, channels) and is never negative, and so is the mean.
    """
    # The sums around a pixel that is brighter by far cancel to below 0.
    mean: FloatImage = np.maximum(signed_mean_around(image, radius, threads), 0)
    return mean


def signed_mean_around(image: FloatImage, radius: int, threads: int) -> FloatImage:
    """Return the same of an image that may be negative."""
    count = window_pixels(image.shape, radius)
    others: FloatImage = _core.box_mean(image, radius, threads) * count - image
    others /= np.maximum(count - 1, 1)
    return others


def largest_around(image: FloatImage, radius: int) -> FloatImage:
    """Return the largest value of the (2 radius + 1)^2 pixels around each, of a shape (height, width, 1)."""
    size = 2 * radius + 1
    for axis in (0, 1):
        margins = [(radius, radius) if axis == a else (0, 0) for a in range(3)]
        padded = np.pad(image, margins, mode="edge")
        image = sliding_window_view(padded, size, axis).max(axis=-1)
    return image
