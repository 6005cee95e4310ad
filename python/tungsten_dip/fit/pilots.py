"""Pilots: closed-form estimates of the clean image, among which a network later chooses pixel by pixel.

A pilot is a local first-order regression of the demodulated colour on the features (`_core.regress`), in a
window of its own, or the mean of the colour along their edges (`_core.smooth_along_edges`), or it uses the
colour alone. Each half is denoised from its own samples alone, so that the noise of the other half, which
scores its pilots, is independent of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.model import Buffer, FloatImage, Halves, RenderBuffers
from tungsten_dip.buffers.prefilter import prefilter_features
from tungsten_dip.fit.layout import Pilot

# Neighbours weigh exp(-sum of penalty times squared difference of features). exp(-1) is reached by normals 34
# degrees apart, by one channel of the albedo 0.22 apart, and at the median depth by a surface 1.85 times as
# far away.
_NORMAL_PENALTY = 3.0
_ALBEDO_PENALTY = 20.0
_DEPTH_PENALTY = 5.0
_DEPTH_SCALE = 3.0
_POSITION_SCALE_PIXELS = 20.0

_LEAST_ALBEDO = 0.01
"""Added to the albedo that divides the colour, so that dark surfaces keep their noise finite."""

_BLACK_ALBEDO = 1e-3
"""Below it a surface's colour (a mirror's, say) does not come from its albedo and is not divided by it."""

_BRIGHTEST_ALBEDO = 1e6
"""The regression does not distinguish brighter emission, in the renderer's units."""

_GUIDE_OFFSET = 0.05
"""Guides are log(irradiance + offset), of radiance for `Pilot.by_color`: far below the offset it is absolute
differences that are visible, not relative ones."""

_GUIDE_NOISE_RADIUS = 3
_LEAST_GUIDE_VARIANCE = 1e-5


_ACROSS_EDGES = 0.3
"""Standard deviation, in pixels, of the mean along edges in the direction across them."""

_CHANNELS = {"albedo": "RGB", "alpha": "A", "normal": "XYZ", "depth": "Z"}

_STRAY = 4.0
_STRAY_RADIUS = 2
"""Emission of one half more than so many times the sum over the other half's 5x5 pixels was hit by chance."""

_SAMPLES_OF_GUIDE = 12
"""About how many independent pixels a guide of all samples averages: no second half is left to estimate its
noise, which is taken to be that of the image divided by this."""


FIRST_GUIDE = Pilot(radius=3)
FIRST_GUIDE_WITHOUT_FEATURES = Pilot(radius=1)
"""Without features, a window blurs every edge within it."""

EDGES = Pilot(6, along_edges=True)

# In order of cost. Small windows keep detail, large ones average out the remaining noise; guided ones keep
# shadows and reflections, which no feature contains; a regression on the position follows gradients.
DRAFT_PILOTS = (Pilot(1), EDGES, Pilot(6, step=2), Pilot(6, k=1.0, step=2))
BALANCED_PILOTS = (
    Pilot(1),
    EDGES,
    Pilot(5),
    Pilot(12, step=2, with_position=True),
    Pilot(4, k=1.0),
    Pilot(10, k=1.0, step=2),
    Pilot(10, k=2.0, step=2, with_position=True),
    Pilot(18, k=1.5, step=2, with_position=True),
    Pilot(4, k=1.0, by_color=True),
)
# Larger windows leave fewer blotches on smooth walls and in fog.
FINAL_PILOTS = (
    *BALANCED_PILOTS,
    Pilot(24, step=3, with_position=True),
    Pilot(32, k=2.0, step=4, with_position=True),
)

# Enough beside the previous frame. The first replaces it where it has no value.
FOLLOWING_DRAFT_PILOTS = (Pilot(1), EDGES, Pilot(8, step=4, with_position=True))
FOLLOWING_PILOTS = (
    Pilot(1),
    EDGES,
    Pilot(12, step=3, with_position=True),
    Pilot(6, k=2.0, step=3),
    Pilot(4, k=1.0, by_color=True),
)


@dataclass(frozen=True)
class Guidance:
    """What all pilots of one half share: the features to regress on, and how the colour is demodulated.

    ``features`` (height, width, n) are pre-filtered and scaled, with one of ``names`` and one ``penalty``
    each. Features that are the same in every pixel are not among them; ``left_out`` maps their names to their
    values. ``albedo`` (height, width, 3), never 0, divides the colour. ``emission`` (height, width, 3) is the
    radiance emitted towards the half's own samples, which is subtracted before, and ``smooth_emission`` the
    denoised one that is added back, both linear and in the units of `evidence.Evidence`. ``edges``, shape
    (height, width, 3), is the features' structure tensor.
    """

    features: FloatImage
    names: tuple[str, ...]
    left_out: dict[str, float]
    penalty: tuple[float, ...]
    albedo: FloatImage
    emission: FloatImage
    smooth_emission: FloatImage
    edges: FloatImage
    threads: int

    def irradiance(self, color: FloatImage) -> FloatImage:
        """Return the irradiance (colour without emission, divided by albedo) of a noisy half ``color``."""
        irradiance: FloatImage = (color - self.emission) / self.albedo
        return irradiance

    def color(self, irradiance: FloatImage) -> FloatImage:
        """Return the radiance, never negative, of surfaces under this irradiance and of lights."""
        color: FloatImage = np.maximum(irradiance, 0) * self.albedo + self.smooth_emission
        return color


@dataclass(frozen=True)
class Guides:
    """What guided pilots compare and denoise, one image for each half or for the mean, (height, width, 3).

    ``images`` are smoothed log irradiance, or log radiance for pilots ``by_color``. ``noise`` is the variance
    of one of them, ``irradiances`` the noisy irradiance (or radiance) that is regressed.
    """

    images: tuple[FloatImage, ...]
    noise: FloatImage
    irradiances: tuple[FloatImage, ...]


def guidance_of_halves(
    buffers: RenderBuffers, colors: tuple[FloatImage, ...], scale: float, threads: int
) -> tuple[Guidance, ...]:
    """Pre-filter, scale and select the features of sanitised buffers; return the guidance of every colour.

    ``colors`` are the two halves, or the mean alone: linear radiance in the renderer's units times ``scale``,
    shape (height, width, 3). The guidance of a half is computed from its own samples alone (the other half
    only determines which of them are averaged), since errors that a half's features share with the colour
    that scores them would be mistaken for signal. Features without halves, and alpha, which has none, are the
    exception.
    """
    count = len(colors)
    alpha = alpha_as_albedo(buffers)
    if alpha is not None:
        buffers = replace(buffers, albedo=Buffer(np.repeat(alpha, 3, axis=2)))
    albedos: tuple[FloatImage, ...] = ()
    if buffers.albedo is not None:
        rendered = _without_stray_emission(buffers.albedo, threads)
        albedos = _bounded_albedos(rendered, colors, scale)
        buffers = replace(buffers, albedo=_with_planes(rendered, albedos))
    filtered = prefilter_features(buffers, threads)
    depth_scale = _depth_scale(filtered)
    planes_of_colors = [
        _feature_planes(filtered, index, count, depth_scale, of_alpha=alpha is not None)
        for index in range(count)
    ]
    flat = [
        name
        for name in planes_of_colors[0]
        if all(np.ptp(planes[name][0]) == 0 for planes in planes_of_colors)
    ]
    surfaces: Sequence[tuple[FloatImage, FloatImage] | None] = [None] * count
    if filtered.albedo is not None:
        surfaces = list(zip(albedos, _planes(filtered.albedo, count), strict=True))
    return tuple(
        _guidance(planes, flat, surface, color.shape, scale, threads)
        for planes, surface, color in zip(planes_of_colors, surfaces, colors, strict=True)
    )


def alpha_as_albedo(buffers: RenderBuffers) -> FloatImage | None:
    """Return the alpha, 0 to 1, that takes the place of a missing albedo, shape (height, width, 1).

    Premultiplied colour is that of surfaces times their coverage, as it is their irradiance times albedo.
    """
    if buffers.albedo is not None or buffers.alpha is None:
        return None
    alpha: FloatImage = np.clip(np.nan_to_num(buffers.alpha), 0, 1)
    return alpha


def _bounded_albedos(albedo: Buffer, colors: tuple[FloatImage, ...], scale: float) -> tuple[FloatImage, ...]:
    """Return the albedo for every colour, bounded by 1 plus the radiance of that colour.

    Above 1 it is emitted light, which the colour must contain too. What the colour does not contain is an
    outlier, and would be smeared over its surroundings.
    """
    return tuple(
        np.minimum(plane, 1 + np.maximum(color / np.float32(scale), 0))
        for plane, color in zip(_planes(albedo, len(colors)), colors, strict=True)
    )


def _with_planes(feature: Buffer, planes: tuple[FloatImage, ...]) -> Buffer:
    """Replace the halves of a feature or, of one without halves or for one colour, the mean."""
    if feature.halves is None or len(planes) == 1:
        return replace(feature, mean=planes[0])
    a, b = planes
    return Buffer(np.float32(0.5) * (a + b), a, b, feature.variance)


def _depth_scale(filtered: RenderBuffers) -> float:
    """Return the median depth of the pixels that hit a surface; 1 if none did."""
    if filtered.depth is None:
        return 1.0
    hit = filtered.depth.mean[filtered.depth.mean > 0]
    return float(np.median(hit)) if hit.size else 1.0


def _guidance(
    planes: dict[str, tuple[FloatImage, float]],
    flat: Sequence[str],
    albedos: tuple[FloatImage, FloatImage] | None,
    shape: tuple[int, ...],
    scale: float,
    threads: int,
) -> Guidance:
    """Return the guidance of one colour of this shape.

    ``planes`` are those of `_feature_planes`, of which those named by ``flat`` are left out. ``albedos`` is
    the albedo before and after pre-filtering, if there is one.
    """
    kept = tuple(name for name in planes if name not in flat)
    features = np.empty((*shape[:2], len(kept)), np.float32)
    for index, name in enumerate(kept):
        features[:, :, index] = planes[name][0]
    penalty = tuple(planes[name][1] for name in kept)
    edges = _core.structure_tensor(features * np.sqrt(np.array(penalty, np.float32)), threads)
    albedo = np.ones(shape, np.float32)
    emission = smooth_emission = np.zeros(shape, np.float32)
    if albedos is not None:
        noisy, smooth = albedos
        albedo = divisor(np.clip(smooth, 0, 1))
        emission = np.maximum(noisy - 1, 0) * np.float32(scale)
        smooth_emission = np.maximum(smooth - 1, 0) * np.float32(scale)
        if emission.any():
            smooth_emission = _smooth_emission(emission, smooth_emission, edges, threads)
    left_out = {name: float(planes[name][0][0, 0]) for name in flat}
    return Guidance(features, kept, left_out, penalty, albedo, emission, smooth_emission, edges, threads)


def _smooth_emission(
    emission: FloatImage, filtered: FloatImage, edges: FloatImage, threads: int
) -> FloatImage:
    # The pre-filter blurs long edges of bright lights, the mean along edges their corners.
    smooth: FloatImage = np.float32(0.5) * (filtered + _along_edges(emission, edges, EDGES.radius, threads))
    return smooth


def _without_stray_emission(albedo: Buffer, threads: int) -> Buffer:
    """Return an albedo above 1 only where both halves saw emission, in about the same place.

    A path that hit a light through glass or a mirror by chance is noise, and remains in the colour: as
    emission it would not be denoised.
    """
    if albedo.halves is None or not (albedo.mean > 1).any():
        return albedo
    a, b = albedo.halves
    limits = (
        1 + np.float32(_STRAY * (2 * _STRAY_RADIUS + 1) ** 2) * np.maximum(around, 0)
        for around in (_core.box_mean(np.maximum(half - 1, 0), _STRAY_RADIUS, threads) for half in (b, a))
    )
    kept_a, kept_b = (np.minimum(half, limit) for half, limit in zip((a, b), limits, strict=True))
    taken = np.float32(0.5) * ((a - kept_a) + (b - kept_b))
    return replace(albedo, mean=albedo.mean - taken, half_a=kept_a, half_b=kept_b)


def _feature_planes(
    filtered: RenderBuffers, index: int, count: int, depth_scale: float, of_alpha: bool
) -> dict[str, tuple[FloatImage, float]]:
    """Return every channel of the features of one of ``count`` colours, scaled, and its penalty.

    ``of_alpha``: the albedo is alpha, three times.
    """
    scaled: list[tuple[str, FloatImage, float]] = []
    if filtered.albedo is not None:
        albedo = _planes(filtered.albedo, count)[index]
        # Light must not mix with what it lights, but may be brighter by any factor.
        brightness = np.log(np.clip(albedo, 1, _BRIGHTEST_ALBEDO))
        surfaces = np.clip(albedo, 0, 1) + brightness
        if of_alpha:
            scaled.append(("alpha", surfaces[:, :, :1], 3 * _ALBEDO_PENALTY))
        else:
            scaled.append(("albedo", surfaces, _ALBEDO_PENALTY))
    if filtered.normal is not None:
        normal = np.clip(_planes(filtered.normal, count)[index], -1, 1)
        scaled.append(("normal", normal, _NORMAL_PENALTY))
    if filtered.depth is not None:
        depth = _planes(filtered.depth, count)[index]
        # Bounded for any unit of length; near and far surfaces stay apart.
        bounded = np.float32(_DEPTH_SCALE) * depth / (depth + np.float32(depth_scale))
        scaled.append(("depth", bounded, _DEPTH_PENALTY))
    return {
        f"{name}.{channel}": (image[:, :, column], penalty)
        for name, image, penalty in scaled
        for column, channel in enumerate(_CHANNELS[name])
    }


def _planes(feature: Buffer, count: int) -> tuple[FloatImage, ...]:
    """Both halves of a feature, or its mean alone for one colour."""
    return feature.halves_or_mean if count == 2 else (feature.mean,)


def divisor(albedo: FloatImage) -> FloatImage:
    """Return the albedo by which the colour is divided, shape (height, width, 3), never 0."""
    black = channel_mean(albedo) < _BLACK_ALBEDO
    return np.where(black, np.float32(1), albedo + np.float32(_LEAST_ALBEDO))


def first_guides(
    colors: tuple[FloatImage, ...], guidance: tuple[Guidance, ...], variance: FloatImage | None = None
) -> Guides:
    """Return the guides of the two halves, or of the mean alone.

    The noise of guides is estimated from the difference of the halves' or, for the mean alone, from its
    ``variance`` (same shape).
    """
    irradiances = tuple(g.irradiance(color) for g, color in zip(guidance, colors, strict=True))
    first = FIRST_GUIDE if guidance[0].penalty else FIRST_GUIDE_WITHOUT_FEATURES
    smooth = tuple(
        np.maximum(_regress(image, first, g), 0) for image, g in zip(irradiances, guidance, strict=True)
    )
    guides = _guides(smooth, irradiances, guidance[0], variance)
    second = Pilot(radius=8, k=1.0, step=2)
    smooth = tuple(
        np.maximum(_regress(image, second, g, guide, guides.noise), 0)
        for image, guide, g in zip(irradiances, guides.images, guidance, strict=True)
    )
    return _guides(smooth, irradiances, guidance[0], variance)


def following_guides(
    colors: Halves, previous: Halves, guidance: tuple[Guidance, ...]
) -> tuple[Guides, Halves, Halves]:
    """Return guides as `first_guides`, at a part of its cost.

    ``previous`` are the halves of the previous frame's result, reprojected to this one, NaN where they have
    no value. They are the guide, filled by the first of `FOLLOWING_PILOTS`. Returns (guides, first pilot,
    filled previous frame), the last two as linear radiance.
    """
    irradiance_a, irradiance_b = (g.irradiance(color) for g, color in zip(guidance, colors, strict=True))
    irradiances = irradiance_a, irradiance_b
    first_a, first_b = (
        g.color(_regress(image, FOLLOWING_PILOTS[0], g))
        for image, g in zip(irradiances, guidance, strict=True)
    )
    filled_a, filled_b = (
        np.where(np.isfinite(image), np.maximum(image, 0), first).astype(np.float32)
        for image, first in zip(previous, (first_a, first_b), strict=True)
    )
    smooth = tuple(
        np.maximum((image - g.smooth_emission) / g.albedo, 0)
        for image, g in zip((filled_a, filled_b), guidance, strict=True)
    )
    guides = _guides(smooth, irradiances, guidance[0])
    return guides, (first_a, first_b), (filled_a, filled_b)


@dataclass
class PilotMaker:
    """Computes the pilots of both halves, or of the mean alone; ``variance`` as in `first_guides`.

    ``previous``, the filled frame of `following_guides`, is the guide of pilots ``by_color`` if given.
    """

    colors: tuple[FloatImage, ...]
    guidance: tuple[Guidance, ...]
    guides: Guides
    variance: FloatImage | None = None
    previous: Halves | None = None

    def images(self, pilot: Pilot) -> tuple[FloatImage, ...]:
        """Return linear radiance, shape (height, width, 3), never negative, one image for each colour."""
        if pilot.along_edges:
            return tuple(
                _along_edges(color, g.edges, pilot.radius, g.threads)
                for color, g in zip(self.colors, self.guidance, strict=True)
            )
        guidance, guides = self._by_color if pilot.by_color else (self.guidance, self.guides)
        return tuple(
            g.color(_regress(image, pilot, g, guide, guides.noise))
            for image, guide, g in zip(guides.irradiances, guides.images, guidance, strict=True)
        )

    @cached_property
    def _by_color(self) -> tuple[tuple[Guidance, ...], Guides]:
        guidance = tuple(_without_features(g) for g in self.guidance)
        if self.previous is not None:
            return guidance, _guides(self.previous, self.colors, guidance[0])
        return guidance, first_guides(self.colors, guidance, self.variance)


def _without_features(guidance: Guidance) -> Guidance:
    height, width = guidance.features.shape[:2]
    nothing = np.zeros_like(guidance.emission)
    return replace(
        guidance,
        features=np.empty((height, width, 0), np.float32),
        names=(),
        penalty=(),
        albedo=np.ones_like(guidance.albedo),
        emission=nothing,
        smooth_emission=nothing,
    )


def _along_edges(image: FloatImage, edges: FloatImage, radius: float, threads: int) -> FloatImage:
    return _core.smooth_along_edges(
        np.ascontiguousarray(image), edges, along=radius, across=_ACROSS_EDGES, threads=threads
    )


def _guides(
    images: tuple[FloatImage, ...],
    irradiances: tuple[FloatImage, ...],
    guidance: Guidance,
    variance: FloatImage | None = None,
) -> Guides:
    guides = tuple(np.log(image + np.float32(_GUIDE_OFFSET)) for image in images)
    if len(guides) == 2:
        noise = (guides[0] - guides[1]) ** 2 / 2
    else:
        assert variance is not None
        squared = variance / guidance.albedo**2
        noise = squared / (_SAMPLES_OF_GUIDE * (images[0] + np.float32(_GUIDE_OFFSET)) ** 2)
    noise = _core.box_mean(np.ascontiguousarray(noise, np.float32), _GUIDE_NOISE_RADIUS, guidance.threads)
    return Guides(guides, noise + np.float32(_LEAST_GUIDE_VARIANCE), irradiances)


def _regress(
    image: FloatImage,
    pilot: Pilot,
    guidance: Guidance,
    guide: FloatImage | None = None,
    guide_variance: FloatImage | None = None,
) -> FloatImage:
    features, names, penalty = guidance.features, guidance.names, guidance.penalty
    if pilot.with_position:
        features = np.concatenate((features, _positions(image.shape)), axis=2)
        names, penalty = (*names, "column", "row"), (*penalty, 0.0, 0.0)
    if pilot.k is None:
        return _core.regress(
            image, features, penalty, radius=pilot.radius, step=pilot.step, threads=guidance.threads
        )
    return _core.regress(
        image,
        features,
        # A guide distinguishes what differs in irradiance, but not dark surfaces from the empty space behind.
        tuple(p if name.startswith("depth") else 0.0 for name, p in zip(names, penalty, strict=True)),
        guide,
        guide_variance,
        radius=pilot.radius,
        step=pilot.step,
        k=pilot.k,
        threads=guidance.threads,
    )


def _positions(shape: tuple[int, ...]) -> FloatImage:
    rows, columns = np.indices(shape[:2], dtype=np.float32) / np.float32(_POSITION_SCALE_PIXELS)
    return np.stack((columns, rows), axis=2)
