"""Halves for images that come without: the noise of every pixel is split at random into two.

If a pixel's value is a sum of many small contributions, gamma-distributed with shape k, and T is drawn from
Beta(k / 2, k / 2), then 2 T and 2 (1 - T) times the value are as noisy as two halves of the samples, and as
independent (Neufeld et al. 2024, "Data Thinning for Convolution-Closed Distributions"). The shape of such a
value is its squared mean over its variance, so that

    k = (level of the image around the pixel)^2 / (variance of the noise there).

Whatever the distribution, the noise of both is uncorrelated if T has the right variance, which is what
scoring one by the other needs. Below, "shape" without more is this k, of Beta.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.half_buffers import HalvesTest, compare_halves
from tungsten_dip.buffers.prefilter import noise_in
from tungsten_dip.buffers.render_buffers import (
    Buffer,
    FloatArray,
    FloatImage,
    Halves,
    RenderBuffers,
    variance_of_mean,
)
from tungsten_dip.fit.neighbours import largest_around, mean_around
from tungsten_dip.fit.preparation.exposure import exposure, scaled

_Plane = npt.NDArray[np.float64]

_MEAN_RADIUS = 2
_NOISE_RADIUS = 1
"""Radii of the windows of the mean that a pixel differs from, and of the mean squared difference."""

_CORRELATION_RADIUS = 8

_LEAST_SHAPE = 1e-2
"""Shapes below count as this one, and so does that of black, which has neither level nor noise."""

_SHAPE_OF_ONE_SAMPLE = 0.07
"""Where the shape is less, T becomes 0 or 1, in every channel alike: a single sample was so bright."""

_STRAY_OVER_NEIGHBOURS = 8 / 3
"""Emission of more than so many times the mean of the 8 pixels around was hit by chance: a lamp's corner has
three lit neighbours."""

_LEAST_SHAPE_OF_LAMPS = 8.0
"""Hardly any half of a pixel that a lamp fills has less than a quarter of the other one's light."""

_SAMPLES_OF_RIM = 4.0
"""If a part p of n samples hits a lamp at its rim, the number of hits is split among halves with a variance
that is about Beta's for the shape n p / (1 - p) (hypergeometric). Images of few samples need it most."""

_LARGEST_SHAPE = 1e8
"""Both halves of such a pixel are the same to float32's last digits: it has no noise."""


@dataclass(frozen=True)
class HalvedImage:
    """Sanitised buffers whose colour has independent halves.

    ``drawn`` indicates that the halves were drawn from the image; ``notes`` give the reason.
    """

    buffers: RenderBuffers
    drawn: bool = False
    notes: tuple[str, ...] = ()

    @property
    def halves(self) -> Halves:
        """The halves of the colour."""
        return self.buffers.color.halves_or_mean


def with_independent_halves(buffers: RenderBuffers, seed: int, threads: int) -> HalvedImage:
    """Return sanitised buffers with independent halves of the colour.

    Unless the buffers have such halves, they are drawn from the mean of all samples, whose noise is estimated
    from the difference of pixels and their surroundings. The same image and seed give the same halves,
    and the same image times a power of two gives these halves times it.
    """
    color = buffers.color
    test = compare_halves(buffers, threads)
    # Tiny or uniform images cannot be tested: their halves are used unless they are copies.
    untestable = color.halves is not None and np.isnan(test.correlation) and not np.array_equal(*color.halves)
    if test.independent or untestable:
        return HalvedImage(buffers)
    note = (
        f"{_why(buffers, test)}: its noise, estimated from the surrounding pixels, is split at random into "
        f"two; the estimated error may be too low"
    )
    return HalvedImage(_with_drawn_halves(buffers, seed, threads), drawn=True, notes=(note,))


def with_lost_halves_drawn(
    buffers: RenderBuffers, lost: npt.NDArray[np.bool_], threads: int
) -> RenderBuffers:
    """Return sanitised buffers with halves, drawn where ``lost``, from a mean that is the half left there.

    ``lost`` has shape (height, width, 1). The halves elsewhere stay as they are. The variance of the colour
    becomes what the halves drawn show. The same image gives the same halves.
    """
    drawn = _with_drawn_halves(buffers, 0, threads)

    def merged(before: Buffer, after: Buffer) -> Buffer:
        pairs = zip(before.halves_or_mean, after.halves_or_mean, strict=True)
        half_a, half_b = (np.where(lost, split, half) for half, split in pairs)
        return Buffer(before.mean, half_a, half_b, after.variance)

    color = merged(buffers.color, drawn.color)
    if color.variance is not None:
        with np.errstate(over="ignore"):
            squared = np.minimum(variance_of_mean(color.halves_or_mean), np.finfo(np.float32).max)
        color = replace(color, variance=np.where(lost, squared, color.variance))
    albedo = buffers.albedo
    if albedo is not None and drawn.albedo is not None and drawn.albedo is not albedo:
        albedo = merged(albedo, drawn.albedo)
    return buffers.with_quantities(color=color, albedo=albedo)


def _with_drawn_halves(buffers: RenderBuffers, seed: int, threads: int) -> RenderBuffers:
    """Return buffers with halves drawn from the mean, also of the light that the albedo contains."""
    color, albedo = buffers.color, buffers.albedo
    emitted = np.zeros_like(color.mean) if albedo is None else np.maximum(albedo.mean - 1, 0)
    share = _share_of_half_a(color.mean, emitted, seed, threads)
    split = {"color": Buffer(color.mean, *_split(color.mean, share), color.variance)}
    if albedo is not None and emitted.any():
        # The colour contains the emitted light, too, and with the same noise.
        surfaces = (np.minimum(half, 1) for half in albedo.halves_or_mean)
        half_a, half_b = (half + light for half, light in zip(surfaces, _split(emitted, share), strict=True))
        variance = albedo.variance if albedo.halves else noise_in(albedo.mean, threads)
        split["albedo"] = Buffer(albedo.mean, half_a, half_b, variance)
    return buffers.with_quantities(**split)


def _share_of_half_a(color: FloatImage, emitted: FloatImage, seed: int, threads: int) -> FloatImage:
    """Return T, shape (height, width, 3), drawn according to the noise around a pixel.

    It is the same for all channels in as many pixels as their noise is correlated: of a path that found light
    all channels are bright, but not of one that a spectral renderer traced for a single wavelength.
    """
    image = scaled(color, exposure(Buffer(color)))
    random = np.random.default_rng([seed, int(hashlib.sha256(image.data).hexdigest()[:16], 16)])
    around = _core.box_mean(image, _MEAN_RADIUS, threads)
    level_squared = around.astype(np.float64) ** 2
    noise = _noise_around(image, around, threads)
    with np.errstate(divide="ignore", invalid="ignore"):  # NaN where all is black
        beta_shape = level_squared / noise
        beta_shape_of_all = level_squared.sum(axis=2) / noise.sum(axis=2)
    lit, least_of_lamps = _lamps(channel_mean(emitted), threads)
    share = _shares(random, beta_shape_of_all, least_of_lamps)[:, :, None].repeat(3, axis=2)
    one_sample = beta_shape_of_all < _SHAPE_OF_ONE_SAMPLE
    # Whether a pixel's channels have a T each is drawn, too: yes with the probability 1 - correlation.
    apart = random.random(lit.shape) >= _correlation(image, around, threads)[:, :, 0]
    apart &= ~lit & ~one_sample
    share[apart] = _shares(random, beta_shape[apart], 0)
    return share


def _shares(random: np.random.Generator, beta_shape: _Plane, least: FloatArray | float) -> FloatArray:
    """Draw T from Beta for every one of the shapes, which are raised to ``least``."""
    # Of NaN and a number, fmax returns the number.
    bounded = np.minimum(np.fmax(beta_shape, np.maximum(least, _LEAST_SHAPE)), _LARGEST_SHAPE)
    values = random.beta(bounded / 2, bounded / 2)
    return np.where(bounded < _SHAPE_OF_ONE_SAMPLE, np.round(values), values).astype(np.float32)


def _noise_around(image: FloatImage, around: FloatImage, threads: int) -> _Plane:
    """Return the mean squared difference of the pixels around each from what is ``around`` them."""
    squared = (image - around).astype(np.float64) ** 2
    noise: _Plane = _core.box_mean(squared.astype(np.float32), _NOISE_RADIUS, threads).astype(np.float64)
    return noise


def _lamps(light: FloatImage, threads: int) -> tuple[npt.NDArray[np.bool_], FloatArray]:
    """Return where lamps are in plain view, and the least shape there (else 0), each (height, width).

    Their edges are mistaken for noise, but no half may be without them. ``light`` is their emission, shape
    (height, width, 1).
    """
    lit = ((light > 0) & (light <= np.float32(_STRAY_OVER_NEIGHBOURS) * mean_around(light, 1, threads)))[
        :, :, 0
    ]
    return lit, np.where(lit, _least_shape_of_lamps(light)[:, :, 0], 0)


def _least_shape_of_lamps(light: FloatImage) -> FloatImage:
    """Return the least shape for pixels of which a lamp fills a part, shape (height, width, 1).

    That part is a pixel's light relative to the brightest of the 3x3 pixels around it.
    """
    part = light / np.maximum(largest_around(light, 1), np.float32(1e-30))
    unfilled = np.maximum(np.float32(1) - part, np.float32(1e-3))
    return np.minimum(np.float32(_SAMPLES_OF_RIM) * part / unfilled, np.float32(_LEAST_SHAPE_OF_LAMPS))


def _correlation(image: FloatImage, around: FloatImage, threads: int) -> FloatImage:
    """Return the correlation, 0 to 1, of the channels' noise around a pixel, shape (height, width, 1)."""
    relative = (image - around) / np.maximum(around, np.float32(1e-15))
    variance, total = (
        _core.box_mean(values, _CORRELATION_RADIUS, threads)
        for values in (channel_mean(relative**2), channel_mean(relative) ** 2)
    )
    # (a + b + c)^2 = a^2 + b^2 + c^2 + 2 (ab + bc + ca)
    covariance = (3 * total - variance) / 2
    correlation: FloatImage = np.clip(covariance / np.maximum(variance, np.float32(1e-30)), 0, 1)
    return correlation


def _split(image: FloatImage, share: FloatImage) -> Halves:
    twice = 2 * image
    return twice * share, twice * (1 - share)


def _why(buffers: RenderBuffers, test: HalvesTest) -> str:
    if buffers.color.halves is None:
        return "the image has no half buffers that can be used"
    if np.isnan(test.correlation) and np.array_equal(*buffers.color.halves):
        return "the image's half buffers are copies"
    return f"the image's half buffers are not independent (correlation {test.correlation:.2f})"
