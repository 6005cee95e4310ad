"""Pilots: closed-form guesses at the clean image, among which a network later chooses pixel by pixel.

A pilot is a local first-order regression of the demodulated colour on the features (`_core.regress`), in a
window of its own, or the mean of the colour along their edges (`_core.smooth_along_edges`), or it sees the
colour alone. Each half of the samples is denoised from its own samples alone: what one half's pilots predict
is scored by the other half, whose noise they have never seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.model import Buffer, FloatImage, Halves, RenderBuffers
from tungsten_dip.buffers.prefilter import prefilter_features

# Features are scaled so that one unit is a difference which separates two surfaces; these penalties of
# squared differences stand for normals 35 degrees apart, albedos 0.2 apart and depths a tenth of the scene's
# apart.
_NORMAL_PENALTY = 3.0
_ALBEDO_PENALTY = 20.0
_DEPTH_PENALTY = 5.0
_DEPTH_SCALE = 3.0
_POSITION_SCALE_PIXELS = 20.0

_LEAST_ALBEDO = 0.01
"""Added to the albedo that divides the colour, so that dark surfaces keep their noise finite."""

_BLACK_ALBEDO = 1e-3
"""Below it a surface's colour cannot come from its albedo (a specular one, say) and is not divided by it."""

_BRIGHTEST_ALBEDO = 1e6
"""Brighter light, in the renderer's units, looks the same to the regression."""

_GUIDE_OFFSET = 0.05
"""Guides are compared as log(radiance + offset), where the eye stops to see noise as relative."""

_GUIDE_NOISE_RADIUS = 3
_LEAST_GUIDE_VARIANCE = 1e-5


_ACROSS_EDGES = 0.3
"""Standard deviation, in pixels, of the mean along edges in the direction across them."""

_CHANNELS = {"albedo": "RGB", "normal": "XYZ", "depth": "Z"}

_STRAY = 4.0
_STRAY_RADIUS = 2
"""Emission of one half so many times what the other half saw in the 5x5 pixels around was seen by chance."""

_SAMPLES_OF_GUIDE = 12
"""About how many independent pixels a guide of all samples averages: its noise, which no second half tells,
is that of the image divided by this."""


@dataclass(frozen=True)
class Pilot:
    """One window of regression. ``k`` None: neighbours are weighed by features alone, not by a guide.

    ``along_edges``: no regression, but the mean along the edges of the features, with the standard deviation
    ``radius``. It shows how much of a pixel each surface covers better than the samples in the pixel do.
    ``by_color``: without features and albedo, which on mirrors, in glass and out of focus are as noisy as the
    colour.
    """

    radius: int
    k: float | None = None
    step: int = 1
    with_position: bool = False
    along_edges: bool = False
    by_color: bool = False


FIRST_GUIDE = Pilot(radius=3)
FIRST_GUIDE_WITHOUT_FEATURES = Pilot(radius=1)
"""Where no feature shows an edge, a window blurs every one within it."""

EDGES = Pilot(6, along_edges=True)

# In order of cost. Small windows keep detail, large ones even out what remains of the noise; guided ones keep
# shadows and reflections, which no feature shows; a regression on the position follows gradients.
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

# Enough beside what the previous frame shows. The first stands where that shows nothing.
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
    """What all pilots of one half share: features to regress on, and what parts the colour from its surface.

    ``features`` has shape (height, width, n), noise-reduced, scaled, without those that are the same in
    every pixel, called ``names``; ``penalty`` one value for each. ``left_out`` holds the value of each of the
    others. ``albedo``, shape (height, width, 3), divides the colour and is never 0. ``emission`` is the
    radiance that the half's own samples saw lights emit, which is taken from the colour before,
    ``smooth_emission`` what is given back. ``edges`` is the features' structure tensor.
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
        """Return what falls on the surfaces that a half shows in ``color``."""
        irradiance: FloatImage = (color - self.emission) / self.albedo
        return irradiance

    def color(self, irradiance: FloatImage) -> FloatImage:
        """Return the radiance, never negative, that surfaces and lights send back."""
        color: FloatImage = np.maximum(irradiance, 0) * self.albedo + self.smooth_emission
        return color


@dataclass(frozen=True)
class Guides:
    """What the guided pilots compare: ``images``, log radiance, one for each half or for the mean.

    ``noise`` is the variance of one of them, shape (height, width, 3), ``irradiances`` what is smoothed.
    """

    images: tuple[FloatImage, ...]
    noise: FloatImage
    irradiances: tuple[FloatImage, ...]


def guidance_of_halves(
    buffers: RenderBuffers, colors: tuple[FloatImage, ...], scale: float, threads: int
) -> tuple[Guidance, ...]:
    """Pre-filter, scale and select the features of sanitised buffers; return the guidance of every colour.

    ``colors`` are the two halves, or the mean alone, in the renderer's units times ``scale``. What guides a
    half is made of its own samples alone (the other half only says which of them to average), since errors
    that a half's features share with the colour that scores them would pass for truth.
    """
    shown = tuple(color / np.float32(scale) for color in colors)
    albedos: tuple[FloatImage, ...] = ()
    if buffers.albedo is not None:
        given = _without_stray_emission(buffers.albedo, threads)
        # Above 1 it is light that a surface emits, which the colour must show too. What the colour does not
        # show is a wild value, and would be smeared over its surroundings.
        albedos = tuple(
            np.minimum(albedo, 1 + np.maximum(color, 0))
            for albedo, color in zip(_planes(given, len(colors)), shown, strict=True)
        )
        if given.halves is not None and len(colors) == 2:
            a, b = albedos
            bounded = Buffer(np.float32(0.5) * (a + b), a, b, given.variance)
        else:
            bounded = replace(given, mean=albedos[0])
        buffers = replace(buffers, albedo=bounded)
    filtered = prefilter_features(buffers, threads)
    depth_scale = 1.0
    if filtered.depth is not None:
        hit = filtered.depth.mean[filtered.depth.mean > 0]
        depth_scale = float(np.median(hit)) if hit.size else 1.0

    planes_of_halves = [
        _feature_planes(filtered, half, len(colors), depth_scale) for half in range(len(colors))
    ]
    names = tuple(planes_of_halves[0])
    flat = [name for name in names if all(np.ptp(planes[name][0]) == 0 for planes in planes_of_halves)]
    kept = tuple(name for name in names if name not in flat)
    guidance = []
    for half, planes in enumerate(planes_of_halves):
        features = np.empty((*shown[half].shape[:2], len(kept)), np.float32)
        for index, name in enumerate(kept):
            features[:, :, index] = planes[name][0]
        penalty = tuple(planes[name][1] for name in kept)
        edges = _core.structure_tensor(features * np.sqrt(np.array(penalty, np.float32)), threads)
        albedo = np.ones(shown[half].shape, np.float32)
        emission = smooth_emission = np.zeros(shown[half].shape, np.float32)
        if filtered.albedo is not None:
            smooth = _planes(filtered.albedo, len(colors))[half]
            albedo = divisor(np.clip(smooth, 0, 1))
            emission = np.maximum(albedos[half] - 1, 0) * np.float32(scale)
            smooth_emission = np.maximum(smooth - 1, 0) * np.float32(scale)
            if emission.any():
                smooth_emission = _smooth_emission(emission, smooth_emission, edges, threads)
        left_out = {name: float(planes[name][0][0, 0]) for name in flat}
        guidance.append(
            Guidance(features, kept, left_out, penalty, albedo, emission, smooth_emission, edges, threads)
        )
    return tuple(guidance)


def _smooth_emission(
    emission: FloatImage, filtered: FloatImage, edges: FloatImage, threads: int
) -> FloatImage:
    """The pre-filter blurs long edges of bright lights, the mean along edges their corners."""
    smooth: FloatImage = np.float32(0.5) * (filtered + _along_edges(emission, edges, EDGES.radius, threads))
    return smooth


def _without_stray_emission(albedo: Buffer, threads: int) -> Buffer:
    """Return an albedo above 1 only where both halves saw light emitted, in about the same place.

    A path that chanced upon a light through glass or a mirror is noise, and left to the colour: as emission
    it would stay where it is, and be believed.
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
    filtered: RenderBuffers, half: int, halves: int, depth_scale: float
) -> dict[str, tuple[FloatImage, float]]:
    """Every channel of a half's features, scaled, and its penalty."""
    scaled: list[tuple[str, FloatImage, float]] = []
    if filtered.albedo is not None:
        albedo = _planes(filtered.albedo, halves)[half]
        # Light must not mix with what it lights, but may be brighter by any factor.
        brightness = np.log(np.clip(albedo, 1, _BRIGHTEST_ALBEDO))
        scaled.append(("albedo", np.clip(albedo, 0, 1) + brightness, _ALBEDO_PENALTY))
    if filtered.normal is not None:
        normal = np.clip(_planes(filtered.normal, halves)[half], -1, 1)
        scaled.append(("normal", normal, _NORMAL_PENALTY))
    if filtered.depth is not None:
        depth = _planes(filtered.depth, halves)[half]
        # Bounded for any unit of length; near and far surfaces stay apart.
        bounded = np.float32(_DEPTH_SCALE) * depth / (depth + np.float32(depth_scale))
        scaled.append(("depth", bounded, _DEPTH_PENALTY))
    return {
        f"{name}.{channel}": (image[:, :, index], penalty)
        for name, image, penalty in scaled
        for index, channel in enumerate(_CHANNELS[name])
    }


def _planes(feature: Buffer, count: int) -> tuple[FloatImage, ...]:
    """Both halves of a feature, or its mean ``count`` times."""
    return feature.halves_or_mean if count == 2 else (feature.mean,)


def divisor(albedo: FloatImage) -> FloatImage:
    """Return what divides the colour of surfaces of this albedo, so that light is left."""
    black = channel_mean(albedo) < _BLACK_ALBEDO
    return np.where(black, np.float32(1), albedo + np.float32(_LEAST_ALBEDO))


def first_guides(
    colors: tuple[FloatImage, ...], guidance: tuple[Guidance, ...], variance: FloatImage | None = None
) -> Guides:
    """Return the guides of the two halves, or of the mean alone.

    How noisy guides are is told by the difference of the halves' or, of the mean alone, by its ``variance``
    (same shape).
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

    ``previous`` is what the previous frame's halves show of this one, NaN where they show nothing. It is the
    guide, filled by the first of `FOLLOWING_PILOTS`; both come as well: (guides, first pilot, filled).
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
    shown = tuple(
        np.maximum((image - g.smooth_emission) / g.albedo, 0)
        for image, g in zip((filled_a, filled_b), guidance, strict=True)
    )
    guides = _guides(shown, irradiances, guidance[0])
    return guides, (first_a, first_b), (filled_a, filled_b)


@dataclass
class PilotMaker:
    """Makes the pilots of both halves, or of the mean alone; ``variance`` as `first_guides` takes it.

    ``previous``, what `following_guides` has filled, guides those that see the colour alone, if it is there.
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
        # A guide tells what differs in light apart, but not dark surfaces from the empty space behind.
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
