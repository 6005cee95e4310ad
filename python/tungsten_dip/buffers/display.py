"""Display values: linear radiance clipped to [0, 1] with a gamma of 2.2, and back; features as Tungsten's."""

from __future__ import annotations

import numpy as np

from tungsten_dip.buffers.render_buffers import FloatArray, FloatImage, Quantity

_GAMMA = 2.2


def ldr_from_radiance(radiance: FloatArray) -> FloatArray:
    """Return display values in [0, 1] of linear radiance, any shape: clipped to [0, 1], gamma 2.2."""
    return np.clip(radiance, 0, 1) ** np.float32(1 / _GAMMA)


def radiance_from_ldr(ldr: FloatArray) -> FloatArray:
    """Undo `ldr_from_radiance`, except for its clipping."""
    return ldr ** np.float32(_GAMMA)


def ldr_from_feature(quantity: Quantity, values: FloatImage) -> FloatImage:
    """Return a feature's mean, or one of its halves, as Tungsten displays it (`OutputBuffer::saveLdr`).

    Values in [0, 1]: normals are (n + 1) / 2, depth is divided by its largest value, others are clipped.
    """
    if quantity == "normal":
        values = np.float32(0.5) * (values + 1)
    elif quantity == "depth":
        values = values / max(values.max(initial=0, where=np.isfinite(values)), np.finfo(np.float32).tiny)
    return np.clip(values, 0, 1)
