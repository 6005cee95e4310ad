"""Moves the result towards the blended pilots of all samples, with the weights found from the halves.

Guides and features of all samples have half the noise variance, so that their pilots resolve more than the
mean of two pilots of a half each. But no independent samples are left to score them, and they retain
outliers.
"""

from __future__ import annotations

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.render_buffers import FloatImage, Halves, mean_of

_SPREAD_RADIUS = 3
_AGREED = 0.25
"""Relative difference of the halves' results from their mean at which all samples get weight 0.5."""


def with_all_samples(denoised: Halves, all_samples_blend: FloatImage, threads: int) -> FloatImage:
    """Return the mean of both halves' results, moved towards the blended pilots of all samples.

    All are linear radiance of shape (height, width, 3). The result moves no further than the halves' results
    differ in the surrounding pixels, and less where they differ strongly.
    """
    a, b = denoised
    image = mean_of(denoised)
    spread = _core.box_mean(channel_mean(np.float32(0.25) * (a - b) ** 2), _SPREAD_RADIUS, threads)
    level = _core.box_mean(channel_mean(image), _SPREAD_RADIUS, threads)
    agreed = (np.float32(_AGREED) * level) ** 2
    share = agreed / (agreed + spread + np.float32(1e-30))
    bound = np.sqrt(spread)
    moved: FloatImage = image + share * np.clip(all_samples_blend - image, -bound, bound)
    return moved
