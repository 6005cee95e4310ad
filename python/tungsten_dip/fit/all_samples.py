"""What all samples together say, once their halves have told which pilots are right.

A pilot that sees all samples compares pixels by half the noise, and tells more apart than the mean of two
pilots that saw a half each. But nothing is left to score it, and what it makes of an outlier may look true.
"""

from __future__ import annotations

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.model import FloatImage, Halves

_SPREAD_RADIUS = 3
_AGREED = 0.25
"""Relative difference of the halves' results from their mean at which all samples are half believed."""


def with_all_samples(fused: Halves, whole: FloatImage, threads: int) -> FloatImage:
    """Return the mean of both halves' results, moved towards what the same weights make of all samples.

    All have shape (height, width, 3). ``whole`` is followed no further than the halves' results differ in the
    pixels around, and less where they differ by much.
    """
    a, b = fused
    image = np.float32(0.5) * (a + b)
    spread = _core.box_mean(channel_mean(np.float32(0.25) * (a - b) ** 2), _SPREAD_RADIUS, threads)
    level = _core.box_mean(channel_mean(image), _SPREAD_RADIUS, threads)
    agreed = (np.float32(_AGREED) * level) ** 2
    share = agreed / (agreed + spread + np.float32(1e-30))
    bound = np.sqrt(spread)
    moved: FloatImage = image + share * np.clip(whole - image, -bound, bound)
    return moved
