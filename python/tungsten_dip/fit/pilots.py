"""Pilots: closed-form guesses at the clean image, among which a network later chooses pixel by pixel.

Every pilot is a local first-order regression of the demodulated colour on the features (`_core.regress`), in
a window of its own. Each half of the samples is denoised from its own samples alone: what one half's pilots
predict is scored by the other half, whose noise they have never seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.model import FloatImage, RenderBuffers
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

_Pair = tuple[FloatImage, FloatImage]

_CHANNELS = {"albedo": "RGB", "normal": "XYZ", "depth": "Z"}

_SAMPLES_OF_FIRST_WINDOW = 12
"""About how many independent neighbours the 7x7 window of the first guide averages, used without halves."""


@dataclass(frozen=True)
class Pilot:
    """One window of regression. ``k`` None: neighbours are weighed by features alone, not by a guide."""

    radius: int
    k: float | None = None
    step: int = 1
    with_position: bool = False


FIRST_GUIDE = Pilot(radius=3)
FIRST_GUIDE_WITHOUT_FEATURES = Pilot(radius=1)
"""Where no feature shows an edge, a window blurs every one within it."""

# In order of cost. Small windows keep detail, large ones even out what remains of the noise; guided ones keep
# shadows and reflections, which no feature shows; a regression on the position follows gradients.
DRAFT_PILOTS = (Pilot(1), Pilot(5), Pilot(5, k=1.0))
BALANCED_PILOTS = (
    Pilot(1),
    Pilot(5),
    Pilot(12, step=2, with_position=True),
    Pilot(4, k=1.0),
    Pilot(9, k=1.0),
    Pilot(9, k=2.0, with_position=True),
    Pilot(18, k=1.5, step=2, with_position=True),
)
FINAL_PILOTS = (*BALANCED_PILOTS, Pilot(2, k=1.0), Pilot(9, k=0.5), Pilot(9, k=1.0, with_position=True))

FOLLOWING_PILOTS = (Pilot(2), Pilot(5, k=2.0))
"""Enough beside what the previous frame shows. The first stands where that shows nothing."""


@dataclass(frozen=True)
class Guidance:
    """What all pilots share: features to regress on and the albedo that divides the colour.

    ``features`` has shape (height, width, n), noise-reduced, scaled, without those that are the same in
    every pixel, called ``names``; ``penalty`` one value for each. ``left_out`` holds the value of each of the
    others. ``albedo`` has shape (height, width, 3), never 0.
    """

    features: FloatImage
    names: tuple[str, ...]
    left_out: dict[str, float]
    penalty: tuple[float, ...]
    albedo: FloatImage
    threads: int


def guidance_from_buffers(buffers: RenderBuffers, threads: int) -> Guidance:
    """Pre-filter, scale and select the features of sanitised buffers."""
    filtered = prefilter_features(buffers, threads)
    shape = buffers.color.mean.shape
    scaled: list[tuple[str, FloatImage, float]] = []
    albedo = np.ones(shape, np.float32)
    if filtered.albedo is not None:
        mean = filtered.albedo.mean
        black = mean.mean(axis=2, keepdims=True, dtype=np.float64) < _BLACK_ALBEDO
        # Well above 1 it is light that a surface emits, which the colour must show too. What the colour does
        # not show is a wild value, and would be smeared over its surroundings.
        bounded = np.clip(mean, 0, 2 * np.maximum(buffers.color.mean, 1))
        # Light must not mix with what it lights, but may be brighter by any factor.
        brightness = np.log(np.clip(mean, 1, _BRIGHTEST_ALBEDO))
        scaled.append(("albedo", np.clip(mean, 0, 1) + brightness, _ALBEDO_PENALTY))
        albedo = np.where(black, np.float32(1), bounded + np.float32(_LEAST_ALBEDO))
    if filtered.normal is not None:
        scaled.append(("normal", np.clip(filtered.normal.mean, -1, 1), _NORMAL_PENALTY))
    if filtered.depth is not None:
        depth = filtered.depth.mean
        hit = depth[depth > 0]
        # Bounded for any unit of length; near and far surfaces stay apart.
        typical = np.float32(np.median(hit)) if hit.size else np.float32(1)
        scaled.append(("depth", np.float32(_DEPTH_SCALE) * depth / (depth + typical), _DEPTH_PENALTY))
    planes = {
        f"{name}.{channel}": (image[:, :, index], penalty)
        for name, image, penalty in scaled
        for index, channel in enumerate(_CHANNELS[name])
    }
    left_out = {name: float(plane[0, 0]) for name, (plane, _) in planes.items() if np.ptp(plane) == 0}
    names = tuple(name for name in planes if name not in left_out)
    features = np.empty((*shape[:2], len(names)), np.float32)
    for index, name in enumerate(names):
        features[:, :, index] = planes[name][0]
    return Guidance(features, names, left_out, tuple(planes[name][1] for name in names), albedo, threads)


def first_pilots(
    colors: tuple[FloatImage, ...], variance: FloatImage | None, guidance: Guidance
) -> tuple[tuple[FloatImage, ...], tuple[FloatImage, ...], FloatImage]:
    """Return (guides, demodulated colours, guide variance) for the guided pilots.

    ``colors`` are the two halves, or the mean alone where there are no halves that can be trusted; then
    ``variance`` (of the mean, same shape) says how noisy it is, and its own residual does where it is None.
    """
    irradiances = tuple(color / guidance.albedo for color in colors)
    first = FIRST_GUIDE if guidance.penalty else FIRST_GUIDE_WITHOUT_FEATURES
    guides = tuple(np.maximum(_regress(image, first, guidance), 0) for image in irradiances)
    guides, noise = _guides(guides, irradiances, variance, guidance)
    second = Pilot(radius=7, k=1.0)
    guides = tuple(
        np.maximum(_regress(image, second, guidance, guide, noise), 0)
        for image, guide in zip(irradiances, guides, strict=True)
    )
    guides, noise = _guides(guides, irradiances, variance, guidance)
    return guides, irradiances, noise


def following_pilots(
    colors: _Pair, previous: _Pair, guidance: Guidance
) -> tuple[_Pair, _Pair, FloatImage, _Pair, _Pair]:
    """Return (guides, demodulated colours, guide variance) as `first_pilots`, at a part of its cost.

    ``previous`` is what the previous frame's halves show of this one, NaN where they show nothing. It is the
    guide, filled by the first of `FOLLOWING_PILOTS`; both come with it: (..., first pilot, filled previous).
    """
    irradiance_a, irradiance_b = (color / guidance.albedo for color in colors)
    irradiances = irradiance_a, irradiance_b
    first_a, first_b = (
        np.maximum(_regress(image, FOLLOWING_PILOTS[0], guidance), 0) * guidance.albedo
        for image in irradiances
    )
    filled_a, filled_b = (
        np.where(np.isfinite(image), np.maximum(image, 0), first).astype(np.float32)
        for image, first in zip(previous, (first_a, first_b), strict=True)
    )
    shown = tuple(image / guidance.albedo for image in (filled_a, filled_b))
    (guide_a, guide_b), noise = _guides(shown, irradiances, None, guidance)
    return (guide_a, guide_b), irradiances, noise, (first_a, first_b), (filled_a, filled_b)


def pilot_images(
    pilot: Pilot,
    irradiances: tuple[FloatImage, ...],
    guides: tuple[FloatImage, ...],
    guide_variance: FloatImage,
    guidance: Guidance,
) -> tuple[FloatImage, ...]:
    """Denoise every half by one pilot; return linear radiance, shape (height, width, 3), never negative."""
    return tuple(
        np.maximum(_regress(image, pilot, guidance, guide, guide_variance), 0) * guidance.albedo
        for image, guide in zip(irradiances, guides, strict=True)
    )


def _guides(
    images: tuple[FloatImage, ...],
    irradiances: tuple[FloatImage, ...],
    variance: FloatImage | None,
    guidance: Guidance,
) -> tuple[tuple[FloatImage, ...], FloatImage]:
    guides = tuple(np.log(image + np.float32(_GUIDE_OFFSET)) for image in images)
    if len(guides) == 2:
        noise = (guides[0] - guides[1]) ** 2 / 2
    else:
        squared = variance / guidance.albedo**2 if variance is not None else (irradiances[0] - images[0]) ** 2
        noise = squared / (_SAMPLES_OF_FIRST_WINDOW * (images[0] + np.float32(_GUIDE_OFFSET)) ** 2)
    noise = _core.box_mean(np.ascontiguousarray(noise, np.float32), _GUIDE_NOISE_RADIUS, guidance.threads)
    return guides, noise + np.float32(_LEAST_GUIDE_VARIANCE)


def _regress(
    image: FloatImage,
    pilot: Pilot,
    guidance: Guidance,
    guide: FloatImage | None = None,
    guide_variance: FloatImage | None = None,
) -> FloatImage:
    features, penalty = guidance.features, guidance.penalty
    if pilot.with_position:
        features = np.concatenate((features, _positions(image.shape)), axis=2)
        penalty = (*penalty, 0.0, 0.0)
    if pilot.k is None:
        return _core.regress(
            image, features, penalty, radius=pilot.radius, step=pilot.step, threads=guidance.threads
        )
    return _core.regress(
        image,
        features,
        (0.0,) * len(penalty),
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
