"""Linear radiance as 8-bit pictures show it, and back: clipped to [0, 1], with a gamma of 2.2."""

from __future__ import annotations

import numpy as np

from tungsten_dip.buffers.model import FloatArray

_GAMMA = 2.2


def ldr_from_radiance(radiance: FloatArray) -> FloatArray:
    """Return display values in [0, 1] of linear radiance, any shape: clipped to [0, 1], gamma 2.2."""
    return np.clip(radiance, 0, 1) ** np.float32(1 / _GAMMA)


def radiance_from_ldr(ldr: FloatArray) -> FloatArray:
    """Undo `ldr_from_radiance`, except for its clipping."""
    return ldr ** np.float32(_GAMMA)
