"""Pre-filtering of features: less noise where there is some, nothing changed where there is none."""

from __future__ import annotations

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.model import FEATURES, Buffer, RenderBuffers
from tungsten_dip.cores import thread_count

_PASSES = ((3, 0.35), (5, 0.5), (5, 0.7))
"""Radius of the window, and standard deviations that pixels may differ by: what one pass leaves is compared
with less noise by the next, which may look further and average more. One pass leaves what features of few
samples show of lights' edges and mirrors as noisy as it is."""


def prefilter_features(buffers: RenderBuffers, threads: int | None = None) -> RenderBuffers:
    """Return buffers whose features are filtered by non-local means, each half with the other's weights.

    As in Bitterli et al. 2016, "Nonlinearly Weighted First-order Regression for Denoising Monte Carlo
    Renderings", section 5.1. The variance of a filtered feature is that of the noise which remains in it.
    Values whose pixel and those next to it have noise of less than a thousandth pass through to the bit, and
    so do features without halves. Normals are not normalised again. Expects sanitised buffers. ``threads``
    None uses every core.
    """
    filtered: dict[str, Buffer | None] = {}
    for name in FEATURES:
        feature: Buffer | None = getattr(buffers, name)
        if feature is not None and feature.halves is not None:
            mean, (half_a, half_b), variance = feature.mean, feature.halves, feature.variance
            for radius, k in _PASSES:
                mean, half_a, half_b, variance = _core.prefilter_feature(
                    mean, half_a, half_b, variance, radius=radius, k=k, threads=thread_count(threads)
                )
            if name != "normal":
                # Where negative values were mended, the mean is not that of the halves, and may fall below 0.
                np.maximum(mean, 0, out=mean)
            filtered[name] = Buffer(mean, half_a, half_b, variance)
    return buffers.with_quantities(**filtered)
