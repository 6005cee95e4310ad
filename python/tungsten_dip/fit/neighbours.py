"""The mean of the pixels around a pixel, without the pixel itself."""

from __future__ import annotations

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.render_buffers import FloatImage


def mean_around(image: FloatImage, radius: int, threads: int) -> FloatImage:
    """Return the mean of the (2 radius + 1)^2 pixels around each, without it (0 where there is no other)."""
    rows, columns = (
        np.minimum(np.arange(n) + radius, n - 1) - np.maximum(np.arange(n) - radius, 0) + 1
        for n in image.shape[:2]
    )
    count: FloatImage = np.outer(rows, columns).astype(np.float32)[..., None]
    others: FloatImage = _core.box_mean(image, radius, threads) * count - image
    others /= np.maximum(count - 1, 1)
    return others
