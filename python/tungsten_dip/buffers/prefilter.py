"""Pre-filtering of features: less noise where there is some, nothing changed where there is none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.render_buffers import FEATURES, TRAITS, Buffer, FloatImage, RenderBuffers

_PASSES = ((3, 1, 0.35), (4, 2, 0.5), (5, 1, 0.7))
"""Radius and step of the window, and standard deviations that pixels may differ by: what one pass leaves is
compared with less noise by the next, which may look further and average more. After one pass, features of
few samples are still noisy at the edges of lights and in mirrors."""


def prefilter_features(buffers: RenderBuffers, threads: int) -> RenderBuffers:
    """Return sanitised buffers with every feature filtered to guide a regression (`prefilter_feature`)."""
    filtered = {
        name: prefilter_feature(feature, _PASSES, threads, signed=TRAITS[name].signed)
        for name in FEATURES
        if (feature := buffers.get(name)) is not None
    }
    return buffers.with_quantities(**filtered)


def prefilter_feature(
    feature: Buffer, passes: Sequence[tuple[int, int, float]], threads: int, *, signed: bool = False
) -> Buffer:
    """Return a sanitised feature filtered by non-local means, each half with the other's weights.

    As in Bitterli et al. 2016, "Nonlinearly Weighted First-order Regression for Denoising Monte Carlo
    Renderings", section 5.1. The variance of the result is that of the noise which remains in it. Values
    whose pixel and those next to it have noise of less than a thousandth pass through to the bit. A feature
    without halves is filtered once, with weights of its own, by the noise estimated from its second
    differences; how much noise remains is then unknown, and so is the variance of the result. ``signed``
    values, such as normals, may be negative; they are not normalised again. ``passes`` are radius, step and
    standard deviations of each.
    """
    mean, (half_a, half_b), variance = feature.mean, feature.halves_or_mean, feature.variance
    if feature.halves is None:
        passes, variance = passes[:1], noise_in(mean, threads)
    for radius, step, k in passes:
        mean, half_a, half_b, variance = _core.prefilter_feature(
            mean, half_a, half_b, variance, radius=radius, step=step, k=k, threads=threads
        )
    if not signed:
        # Where negative values were repaired, the mean is not that of the halves and may be negative.
        np.maximum(mean, 0, out=mean)
    return Buffer(mean) if feature.halves is None else Buffer(mean, half_a, half_b, variance)


def noise_in(image: FloatImage, threads: int) -> FloatImage:
    """Return the variance of an image's noise, estimated from the image, as means over 5x5 pixels.

    Immerkaer's stencil (1996, "Fast Noise Variance Estimation") leaves of an image what is neither constant
    nor linear in either direction: noise, and edges.
    """
    if image.size == 0:
        return image
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    down = padded[:-2] - 2 * padded[1:-1] + padded[2:]
    across = down[:, :-2] - 2 * down[:, 1:-1] + down[:, 2:]
    noise: FloatImage = _core.box_mean(np.ascontiguousarray((across / np.float32(6)) ** 2), 2, threads)
    return noise
