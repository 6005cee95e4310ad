"""What the features show of an image's surfaces, by which its pilots distinguish and demodulate them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.prefilter import prefilter_features
from tungsten_dip.buffers.render_buffers import (
    FEATURES,
    Buffer,
    FloatImage,
    Halves,
    Quantity,
    RenderBuffers,
    mean_of,
)
from tungsten_dip.fit.neighbours import window_pixels
from tungsten_dip.fit.pilots.texture import with_texture

# Neighbours weigh exp(-sum of penalty times squared difference of features). exp(-1) is reached by normals 34
# degrees apart, by one channel of the albedo 0.22 apart, and at the median depth by a surface 1.85 times as
# far away. The depth's scale makes its differences large beside the ridge of the regression: along a wall the
# light changes with the distance, which has to explain it.
_NORMAL_PENALTY = 3.0
_ALBEDO_PENALTY = 20.0
_DEPTH_PENALTY = 0.14
_DEPTH_SCALE = 18.0

_ALBEDO_OFFSET = 0.01
"""Added to the albedo that divides the colour, so that dark surfaces keep their noise finite."""

_BLACK_ALBEDO = 1e-3
"""Below it a surface's colour (a mirror's, say) does not come from its albedo and is not divided by it."""

_BRIGHTEST_ALBEDO = 1e6
"""The regression does not distinguish brighter emission, in the renderer's units."""

EDGES_SIGMA = 6
"""Standard deviation, in pixels, of the means along edges that smooth emission and that are a pilot."""

_ACROSS_EDGES = 0.3
"""Standard deviation, in pixels, of the mean along edges in the direction across them."""

_CHANNELS = {"albedo": "RGB", "alpha": "A", "normal": "XYZ", "depth": "Z"}

_MOST_SMEARED = 4.0
"""Smoothed emission is at most so many times a pixel's own or that of the third brightest of the 3x3 pixels
around it: beside the straight edge of a lamp three are lit, beside a lamp of few pixels, or the sun, less."""

_STRAY_OVER_OTHER_HALF = 4.0
_STRAY_AROUND = 0.6
"""Emission of one half was hit by chance beyond so many times the other half's, or that of all other pixels
of both halves' 3x3, in which two about as bright thus suffice."""

_SPARSE_RADIUS = 8
_SPARSE = 0.1
"""All emission is stray where, of the pixels around in which the halves saw any, both did in less than this
part."""


@dataclass(frozen=True)
class _Channel:
    """A channel of the features, scaled, shape (height, width), and the penalties of its differences.

    Beside a guide ``guided_penalty`` holds: it distinguishes what differs in irradiance by itself.
    """

    image: FloatImage
    penalty: float
    guided_penalty: float = 0.0

    @property
    def flat(self) -> bool:
        """Whether it is the same in every pixel."""
        return bool(np.ptp(self.image) == 0)


@dataclass(frozen=True)
class _Albedo:
    """The albedo of one colour's samples, shape (height, width, 3), with emission above 1.

    ``rendered`` is noisy, ``filtered`` pre-filtered, ``textured`` the latter without emission but with the
    texture that it lost.
    """

    rendered: FloatImage
    filtered: FloatImage
    textured: FloatImage


@dataclass(frozen=True)
class Surfaces:
    """The surfaces as one half shows them: the features to regress on, and how the colour is demodulated.

    ``features`` (height, width, n) are pre-filtered and scaled, with one of ``names`` and one ``penalty``
    each, ``guided_penalty`` beside a guide. Features that are the same in every pixel are not among them;
    ``left_out`` maps their names to their values. ``albedo`` (height, width, 3), never 0, divides the colour.
    ``emission`` (height, width, 3) is the radiance emitted towards the half's own samples, which is
    subtracted before, and ``smooth_emission`` the denoised one that is added back, both linear and in the
    units of `evidence.Evidence`. ``edges``, shape (height, width, 3), is the features' structure tensor.
    """

    features: FloatImage
    names: tuple[str, ...]
    left_out: dict[str, float]
    penalty: tuple[float, ...]
    guided_penalty: tuple[float, ...]
    albedo: FloatImage
    emission: FloatImage
    smooth_emission: FloatImage
    edges: FloatImage

    def irradiance(self, color: FloatImage) -> FloatImage:
        """Return the irradiance (colour without emission, divided by albedo) of a noisy half ``color``."""
        irradiance: FloatImage = (color - self.emission) / self.albedo
        return irradiance

    def reflected(self, irradiance: FloatImage) -> FloatImage:
        """Return the radiance, never negative, of surfaces under this irradiance, without what is emitted."""
        reflected: FloatImage = np.maximum(irradiance, 0) * self.albedo
        return reflected

    def without_features(self) -> Surfaces:
        """Return nothing but the size of the image, for pilots that see the colour alone as irradiance."""
        nothing = np.zeros_like(self.emission)
        return replace(
            self,
            features=np.empty((*self.features.shape[:2], 0), np.float32),
            names=(),
            penalty=(),
            guided_penalty=(),
            albedo=np.ones_like(self.albedo),
            emission=nothing,
            smooth_emission=nothing,
        )


def surfaces_of_colors(
    buffers: RenderBuffers, colors: tuple[FloatImage, ...], scale: float, threads: int
) -> tuple[Surfaces, ...]:
    """Pre-filter, scale and select the features of sanitised buffers; return the surfaces of every colour.

    ``colors`` are the two halves, or the mean alone: linear radiance in the renderer's units times ``scale``,
    shape (height, width, 3). The surfaces of a half are computed from its own samples alone (the other half
    only determines which of them are averaged), since errors that a half's features share with the colour
    that scores them would be mistaken for signal. Features without halves, and alpha, which has none, are the
    exception.
    """
    alpha = alpha_as_albedo(buffers)
    if alpha is not None:
        buffers = replace(buffers, albedo=Buffer(np.repeat(alpha, 3, axis=2)))
    if buffers.albedo is not None:
        rendered = _without_stray_emission(buffers.albedo, threads)
        bounded = _bounded_albedos(rendered, colors, scale)
        buffers = replace(buffers, albedo=_with_planes(rendered, bounded))
    filtered = prefilter_features(buffers, threads)
    albedos: Sequence[_Albedo | None] = [None] * len(colors)
    if buffers.albedo is not None and filtered.albedo is not None:
        textured = with_texture(filtered.albedo, buffers.albedo, threads)
        of_colors = (images_for(colors, albedo) for albedo in (buffers.albedo, filtered.albedo, textured))
        albedos = [_Albedo(*images) for images in zip(*of_colors, strict=True)]
    depth_scale = _depth_scale(filtered)
    images = {
        name: images_for(colors, feature) for name in FEATURES if (feature := filtered.get(name)) is not None
    }
    features = [
        {name: of_colors[index] for name, of_colors in images.items()} for index in range(len(colors))
    ]
    channels = [_channels(of_color, depth_scale, of_alpha=alpha is not None) for of_color in features]
    flat = [name for name in channels[0] if all(of_color[name].flat for of_color in channels)]
    return tuple(
        _surfaces(of_color, flat, albedo, color.shape, scale, threads)
        for of_color, albedo, color in zip(channels, albedos, colors, strict=True)
    )


def images_for(colors: tuple[FloatImage, ...], buffer: Buffer) -> tuple[FloatImage, ...]:
    """Return what of a buffer belongs to each of ``colors``: its halves, or its mean."""
    return buffer.halves_or_mean if len(colors) == 2 else (buffer.mean,)


def emission_of_halves(buffers: RenderBuffers, colors: Halves, scale: float) -> Halves | None:
    """Return the radiance emitted towards the samples of each half, if there is any.

    ``colors`` and the results are linear radiance times ``scale``, shape (height, width, 3), of sanitised
    buffers.
    """
    if buffers.albedo is None or not (buffers.albedo.mean > 1).any():
        return None
    albedos = _bounded_albedos(buffers.albedo, colors, scale)
    a, b = (np.maximum(albedo - 1, 0) * np.float32(scale) for albedo in albedos)
    return a, b


def alpha_as_albedo(buffers: RenderBuffers) -> FloatImage | None:
    """Return the alpha, 0 to 1, that takes the place of a missing albedo, shape (height, width, 1).

    Premultiplied colour is that of surfaces times their coverage, as it is their irradiance times albedo.
    """
    if buffers.albedo is not None or buffers.alpha is None:
        return None
    alpha: FloatImage = np.clip(buffers.alpha, 0, 1)  # of a filter's lobes
    return alpha


def _bounded_albedos(albedo: Buffer, colors: tuple[FloatImage, ...], scale: float) -> tuple[FloatImage, ...]:
    """Return the albedo for every colour, bounded by 1 plus the radiance of that colour.

    Above 1 it is emitted light, which the colour must contain too. What the colour does not contain is an
    outlier, and would be smeared over its surroundings.
    """
    return tuple(
        np.minimum(plane, 1 + np.maximum(color / np.float32(scale), 0))
        for plane, color in zip(images_for(colors, albedo), colors, strict=True)
    )


def _with_planes(feature: Buffer, planes: tuple[FloatImage, ...]) -> Buffer:
    """Replace the halves of a feature or, of one without halves or for one colour, the mean."""
    if feature.halves is None or len(planes) == 1:
        return replace(feature, mean=planes[0])
    a, b = planes
    return Buffer(mean_of((a, b)), a, b, feature.variance)


def _depth_scale(filtered: RenderBuffers) -> float:
    """Return the median depth of the pixels that hit a surface; 1 if none did."""
    if filtered.depth is None:
        return 1.0
    hit = filtered.depth.mean[filtered.depth.mean > 0]
    return float(np.median(hit)) if hit.size else 1.0


def _surfaces(
    channels: dict[str, _Channel],
    flat: Sequence[str],
    albedo: _Albedo | None,
    shape: tuple[int, ...],
    scale: float,
    threads: int,
) -> Surfaces:
    """Return the surfaces of one colour of this shape, with the channels that are not ``flat``."""
    kept = {name: channel for name, channel in channels.items() if name not in flat}
    features = np.empty((*shape[:2], len(kept)), np.float32)
    for index, channel in enumerate(kept.values()):
        features[:, :, index] = channel.image
    penalty = tuple(channel.penalty for channel in kept.values())
    edges = _core.structure_tensor(features * np.sqrt(np.array(penalty, np.float32)), threads)
    divided_by = np.ones(shape, np.float32)
    emission = smooth_emission = np.zeros(shape, np.float32)
    if albedo is not None:
        divided_by = divisor(albedo.textured)
        emission = np.maximum(albedo.rendered - 1, 0) * np.float32(scale)
        smooth_emission = np.maximum(albedo.filtered - 1, 0) * np.float32(scale)
        if emission.any():
            smooth_emission = _smooth_emission(emission, smooth_emission, edges, threads)
    return Surfaces(
        features=features,
        names=tuple(kept),
        left_out={name: float(channels[name].image[0, 0]) for name in flat},
        penalty=penalty,
        guided_penalty=tuple(channel.guided_penalty for channel in kept.values()),
        albedo=divided_by,
        emission=emission,
        smooth_emission=smooth_emission,
        edges=edges,
    )


def _smooth_emission(
    emission: FloatImage, filtered: FloatImage, edges: FloatImage, threads: int
) -> FloatImage:
    # The pre-filter blurs long edges of bright lights, the mean along edges their corners, and both smear
    # lamps of few pixels.
    smooth: FloatImage = np.float32(0.5) * (filtered + along_edges(emission, edges, EDGES_SIGMA, threads))
    own, level = channel_mean(emission)[:, :, 0], channel_mean(smooth)[:, :, 0]
    smeared = np.nonzero(level > np.float32(_MOST_SMEARED) * own)
    windows = sliding_window_view(np.pad(own, 1, mode="edge"), (3, 3))
    third = np.partition(windows[smeared].reshape(-1, 9), 6, axis=1)[:, 6]
    most = np.float32(_MOST_SMEARED) * np.maximum(own[smeared], third)
    smooth[smeared] *= np.minimum(most / level[smeared], 1)[:, None]
    return smooth


def _without_stray_emission(albedo: Buffer, threads: int) -> Buffer:
    """Return an albedo above 1 only where both halves or several pixels around saw about as much emission.

    A path that hit a light out of focus, or through glass or a mirror, by chance is noise, and remains in the
    colour: as emission it would not be denoised. Where many paths do, both halves or neighbours see it by
    chance, too.
    """
    if albedo.halves is None or not (albedo.mean > 1).any():
        return albedo
    emissions = [np.maximum(half - 1, 0) for half in albedo.halves]
    both = emissions[0] + emissions[1]
    around = window_pixels(both.shape, 1) * _core.box_mean(both, 1, threads)
    seen_a, seen_b = (emission.any(axis=2, keepdims=True) for emission in emissions)
    pixels = window_pixels(both.shape, _SPARSE_RADIUS)
    in_both, in_any = (
        pixels * _core.box_mean(np.asarray(seen, np.float32), _SPARSE_RADIUS, threads)
        for seen in (seen_a & seen_b, seen_a | seen_b)
    )
    # Of five pixels or fewer, that none is seen twice tells nothing.
    dense = in_both + np.float32(0.5) >= np.float32(_SPARSE) * in_any
    kept_a, kept_b = (
        np.minimum(
            half, 1 + dense * np.maximum(_STRAY_OVER_OTHER_HALF * other, _STRAY_AROUND * (around - own))
        )
        for half, own, other in zip(albedo.halves, emissions, emissions[::-1], strict=True)
    )
    taken = mean_of((albedo.halves[0] - kept_a, albedo.halves[1] - kept_b))
    return replace(albedo, mean=albedo.mean - taken, half_a=kept_a, half_b=kept_b)


def _channels(
    features: dict[Quantity, FloatImage], depth_scale: float, *, of_alpha: bool
) -> dict[str, _Channel]:
    """Return every channel of the pre-filtered features of one colour, by name.

    ``of_alpha``: the albedo is alpha, three times.
    """
    channels: dict[str, _Channel] = {}

    def add(name: str, image: FloatImage, penalty: float, guided_penalty: float = 0.0) -> None:
        for column, channel in enumerate(_CHANNELS[name]):
            channels[f"{name}.{channel}"] = _Channel(image[:, :, column], penalty, guided_penalty)

    if "albedo" in features:
        albedo = features["albedo"]
        # Light must not mix with what it lights, but may be brighter by any factor.
        brightness = np.log(np.clip(albedo, 1, _BRIGHTEST_ALBEDO))
        bounded = np.clip(albedo, 0, 1) + brightness
        if of_alpha:
            add("alpha", bounded[:, :, :1], 3 * _ALBEDO_PENALTY)
        else:
            add("albedo", bounded, _ALBEDO_PENALTY)
    if "normal" in features:
        add("normal", np.clip(features["normal"], -1, 1), _NORMAL_PENALTY)
    if "depth" in features:
        depth = features["depth"]
        # Bounded for any unit of length; near and far surfaces stay apart.
        bounded = np.float32(_DEPTH_SCALE) * depth / (depth + np.float32(depth_scale))
        # A guide does not distinguish dark surfaces from the empty space behind.
        add("depth", bounded, _DEPTH_PENALTY, guided_penalty=_DEPTH_PENALTY)
    return channels


def divisor(albedo: FloatImage) -> FloatImage:
    """Return the albedo by which the colour is divided, shape (height, width, 3), never 0."""
    black = channel_mean(albedo) < _BLACK_ALBEDO
    return np.where(black, np.float32(1), albedo + np.float32(_ALBEDO_OFFSET))


def along_edges(
    image: FloatImage, edges: FloatImage, sigma: float, threads: int, *, across: float = _ACROSS_EDGES
) -> FloatImage:
    """Return the mean along edges (a structure tensor), with these standard deviations in pixels."""
    return _core.smooth_along_edges(
        np.ascontiguousarray(image), edges, along=sigma, across=across, threads=threads
    )
