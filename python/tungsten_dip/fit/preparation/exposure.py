"""The units in which fits compute: radiance scaled to a typical level, by a power of two."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.render_buffers import Buffer, FloatImage

_TYPICAL_RADIANCE = 0.25
"""Images are scaled so that their lit pixels have about this median: every constant of `fit` relies on it."""

BLACK = 2e-3
"""Added to levels that are compared by their ratio: what is darker than this counts as black."""

_BRIGHTEST = 1e15
"""Brighter pixels, in these units, count as this bright: the squares of their differences overflow."""


def exposure(color: Buffer) -> float:
    """Return the power of two that brings the median of the lit pixels near the typical radiance.

    Pixels count by their noise, the relative difference of their halves, if there are halves: a clear sky has
    none to remove, and what it outshines must not be as if it were black.
    """
    level = _mean(color.mean)
    lit = level > 0
    if not lit.any():
        return 1.0
    half_a, half_b = color.halves_or_mean
    # True halves differ by no more than twice their mean.
    weight = np.minimum(np.abs(_mean(half_a) - _mean(half_b))[lit] / level[lit], 2)
    if not weight.any():
        weight = np.ones_like(weight)
    # The power of two of each pixel's own level, up to what float32 can hold.
    powers = np.clip(np.round(np.log2(_TYPICAL_RADIANCE / level[lit])), -126, 126).astype(np.int64)
    reached = np.bincount(powers + 126, weight).cumsum()
    return float(2.0 ** (np.searchsorted(reached, reached[-1] / 2) - 126))


def _mean(image: FloatImage) -> npt.NDArray[np.float64]:
    """Return the mean over the channels, shape (height, width), which cannot overflow."""
    red, green, blue = (image[:, :, channel].astype(np.float64) for channel in range(3))
    mean: npt.NDArray[np.float64] = (red + green + blue) / 3
    return mean


def scaled(image: FloatImage, scale: float) -> FloatImage:
    """Return radiance times ``scale``, bounded so that squares do not overflow."""
    brightest = min(_BRIGHTEST / scale, float(np.finfo(np.float32).max))
    bounded: FloatImage = np.minimum(image, np.float32(brightest)) * np.float32(scale)
    return bounded


def unscaled(image: FloatImage, scale: float) -> FloatImage:
    """Undo `scaled`, except for its bound; the result is bounded for float32."""
    largest = float(np.finfo(np.float32).max)
    bounded: FloatImage = np.minimum(image, np.float32(min(largest * scale, largest)))
    bounded /= np.float32(scale)
    return bounded
