"""Pictures to look at, as display-referred values in [0, 1]: side by side, and errors in false colour."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.render_buffers import FloatImage

GAP_PX = 4
"""Width of the bar between two pictures side by side."""

FALSE_COLORS = ((0, 0, 4), (66, 15, 117), (147, 38, 103), (221, 81, 58), (252, 165, 10), (252, 255, 164))
"""8-bit colours from no error to the most: dark to light, so that they read in grey too."""


def block_means(image: npt.NDArray[np.floating[Any]], size: int) -> npt.NDArray[np.floating[Any]]:
    """Return the means of blocks of ``size`` x ``size`` pixels, for an image of shape (height, width, ...).

    Rows and columns that do not fill a block are left out; a side shorter than ``size`` is one block.
    """
    rows, columns = (max(1, length // size) for length in image.shape[:2])
    whole = image[: rows * size, : columns * size]
    height, width, *channels = whole.shape
    means: npt.NDArray[np.floating[Any]] = whole.reshape(
        rows, height // rows, columns, width // columns, *channels
    ).mean(axis=(1, 3))
    return means


def side_by_side(left: FloatImage, right: FloatImage) -> FloatImage:
    """Return two pictures of one size beside each other, a white bar between them."""
    bar = np.ones((left.shape[0], GAP_PX, 3), dtype=np.float32)
    return np.concatenate([left, bar, right], axis=1)


def error_in_false_color(error: FloatImage, most: float | None = None) -> tuple[FloatImage, float]:
    """Return a picture of an error map, and the relative error that its brightest colour means.

    The map holds squared relative errors, shape (height, width, 1); the picture, shape (height, width, 3),
    shows their roots from 0 to ``most``, by default the 99th percentile.
    """
    relative = np.sqrt(np.maximum(np.nan_to_num(error[..., 0]), 0))
    most = most or float(np.percentile(relative, 99)) or 1.0
    stops = np.linspace(0, most, len(FALSE_COLORS))
    channels = [np.interp(relative, stops, levels) for levels in np.array(FALSE_COLORS).T / 255]
    return np.stack(channels, axis=-1).astype(np.float32), most
