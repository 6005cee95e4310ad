"""Checks that half buffers are halves of the image's samples, with independent noise, as its variance is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tungsten_dip import _core
from tungsten_dip._core import HalvesTest
from tungsten_dip.buffers.render_buffers import FEATURES, Buffer, RenderBuffers

__all__ = [
    "HalvesTest",
    "compare_halves",
    "without_foreign_halves",
    "without_foreign_variance",
    "without_single_halves",
]

_UNEQUAL = 0.5
"""How far a pixel may lie from (A + B) / 2, over |A - B| / 2. Halves of one and of two samples give 1/3."""

_ROUNDED = 2e-3
"""Relative difference that rounding to 16 bits explains."""

_FOREIGN_SHARE = 0.05
"""Part of the pixels that may lie further away. In renders it is below 0.01."""

_EMPTY_SHARE = 0.5
"""Part of the pixels in which half B may be empty: 0.06 of Tungsten's albedo at 2 samples per pixel, which
paths lost in glass do not reach. Where the image of a single light is mistaken for half B, it is nearly 1."""

_ENOUGH_PIXELS = 1 << 14


def compare_halves(buffers: RenderBuffers, threads: int) -> HalvesTest:
    """Test whether the noise of the colour's halves is independent, as scoring one by the other assumes.

    Halves of a low-discrepancy sampler mirror each other (Tungsten's Sobol sampler: correlation -0.2), and
    halves may be copies of one image. The correlation is taken of what a second-order difference leaves of
    both halves. Where texture makes it positive, the variance of the colour decides; if that is unknown, only
    copies are taken for dependent. Without halves, and where the image does not show it, ``independent`` is
    False. Pixels without a sample tell nothing. Expects sanitised buffers.
    """
    color = buffers.color
    if color.halves is None:
        return HalvesTest()
    half_a, half_b = color.halves
    if isinstance(buffers.spp, np.ndarray) and not buffers.spp.all():
        half_a, half_b = (np.where(buffers.spp > 0, half, np.float32(np.nan)) for half in color.halves)
    return _core.compare_halves(half_a, half_b, color.variance, threads)


def without_single_halves(buffers: RenderBuffers) -> tuple[RenderBuffers, tuple[str, ...]]:
    """Return buffers without halves whose other half is missing, and a line for each quantity.

    Nothing tells whether such a half is one of the samples: its file may hold a light of its own.
    """
    without: dict[str, Buffer | None] = {}
    lines = []
    for name in ("color", *FEATURES):
        buffer = buffers.get(name)
        if buffer is None or (buffer.half_a is None) == (buffer.half_b is None):
            continue
        half, missing = ("A", "B") if buffer.half_b is None else ("B", "A")
        without[name] = replace(buffer, half_a=None, half_b=None)
        lines.append(f"{name}: half buffer {half} is not used, because {missing} is missing")
    return buffers.with_quantities(**without), tuple(lines)


def without_foreign_halves(buffers: RenderBuffers) -> tuple[RenderBuffers, tuple[str, ...]]:
    """Return buffers without those halves whose mean is not the image, and a line for each quantity.

    Such halves were left by another render, or belong to another layer (such as light groups named A and B).
    Expects buffers as rendered: sanitising changes mean and halves, and repairs one from the other.
    """
    alone: dict[str, Buffer | None] = {
        name: Buffer(buffer.mean, variance=buffer.variance)
        for name, buffer in buffers.quantities()
        if name != "visibility" and not _halves_belong(buffer)  # no fit uses it
    }
    lines = tuple(
        f"{name}: the half buffers are not used, because their mean is not the image: they are of another "
        "one, or of a single sample per pixel"
        for name in alone
    )
    return buffers.with_quantities(**alone), lines


def without_foreign_variance(buffers: RenderBuffers, threads: int) -> tuple[RenderBuffers, tuple[str, ...]]:
    """Return buffers without a variance of the colour that its halves contradict, and a line on it.

    It is that of one sample, say, or of another unit. Expects sanitised buffers.
    """
    color = buffers.color
    if color.variance is None:
        return buffers, ()
    test = compare_halves(buffers, threads)
    if test.variance_fits:
        return buffers, ()
    line = (
        "color: the variance is not used: expected that of the mean of all samples, as the half buffers show "
        f"it, got {1 / test.variance_ratio:.3g} times that; divide the variance of one sample by their number"
    )
    return buffers.with_quantities(color=replace(color, variance=None)), (line,)


def _halves_belong(buffer: Buffer) -> bool:
    """Whether nearly every pixel is the mean of its halves, except for rounding and halves of unequal size.

    Pixels that are 0 in all three, which most of an image may be, and those that are not finite, are ignored,
    and so are those whose only sample is in half A, up to `_EMPTY_SHARE` of them.
    """
    if buffer.halves is None:
        return True
    count = buffer.mean[:, :, 0].size
    pixels = np.arange(count)
    if count > _ENOUGH_PIXELS:
        pixels = np.random.default_rng(0).integers(count, size=_ENOUGH_PIXELS)
    mean, a, b = (
        image.reshape(-1, image.shape[2])[pixels].astype(np.float64)
        for image in (buffer.mean, *buffer.halves)
    )
    with np.errstate(invalid="ignore"):
        apart, noise, level = (abs(image).sum(axis=1) for image in ((a + b) / 2 - mean, (a - b) / 2, mean))
        without_b = (b == 0).all(axis=1) & (abs(a - mean).sum(axis=1) <= _ROUNDED * level)
    informative = np.isfinite(apart + noise + level) & (apart + noise + level > 0)
    with_b = informative & ~without_b
    if np.count_nonzero(with_b) < (1 - _EMPTY_SHARE) * np.count_nonzero(informative):
        return False
    foreign = with_b & (apart > _UNEQUAL * noise + _ROUNDED * level)
    return bool(np.count_nonzero(foreign) <= _FOREIGN_SHARE * np.count_nonzero(with_b))
