"""The relative mean squared error, by which renderings are compared with the truth."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.render_buffers import FloatImage

RELMSE_EPSILON = 0.01
"""Keeps relMSE finite on black pixels; the value of Rousselle et al. 2011 (greedy error minimization)."""


def relative_squared_error(image: FloatImage, reference: FloatImage) -> npt.NDArray[np.float64]:
    """Return (x - r)^2 / (r^2 + 0.01) of every value, in the shape of the images; its mean is relMSE."""
    x, r = image.astype(np.float64), reference.astype(np.float64)
    return (x - r) ** 2 / (r**2 + RELMSE_EPSILON)
