"""Pilots: closed-form estimates of the clean image, which a network later blends pixel by pixel.

A pilot is a local first-order regression of the demodulated colour on the features (`_core.regress`), in a
window of its own, or the mean of the colour along their edges (`_core.smooth_along_edges`), or it uses the
colour alone. Each half is denoised from its own samples alone, so that the noise of the other half, which
scores its pilots, is independent of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.render_buffers import FloatImage, Halves
from tungsten_dip.fit.network.layout import Pilot
from tungsten_dip.fit.pilots.presets import FOLLOWING_PILOTS
from tungsten_dip.fit.pilots.surfaces import Surfaces, along_edges

_POSITION_SCALE_PIXELS = 20.0
_GUIDE_OFFSET = 0.05
"""Guides are log(irradiance + offset), of radiance for pilots of kind color: far below the offset it is
absolute differences that are visible, not relative ones."""

_GUIDE_VARIANCE_RADIUS = 3
_LEAST_GUIDE_VARIANCE = 1e-5

_SAMPLES_OF_GUIDE = 12
"""About how many independent pixels a guide of all samples averages: no second half is left to estimate its
noise, which is taken to be that of the image divided by this."""


_FIRST_GUIDE = Pilot("features", 3)
_FIRST_GUIDE_WITHOUT_FEATURES = Pilot("features", 1)
"""Without features, a window blurs every edge within it."""

_SECOND_GUIDE = Pilot("guided", 8, step=2, k=1.0)
"""Guided by the first, it is the guide of all pilots."""


@dataclass(frozen=True)
class Guides:
    """What guided pilots compare and denoise, one image for each half or for the mean, (height, width, 3).

    ``images`` are smoothed log irradiance, or log radiance for pilots of kind color. ``variance`` is
    that of one of them, ``irradiances`` the noisy irradiance (or radiance) that is regressed.
    """

    images: tuple[FloatImage, ...]
    variance: FloatImage
    irradiances: tuple[FloatImage, ...]


def first_guides(
    colors: tuple[FloatImage, ...], surfaces: tuple[Surfaces, ...], color_variance: FloatImage | None = None
) -> Guides:
    """Return the guides of the two halves, or of the mean alone.

    The variance of the guides is estimated from the difference of the halves' or, for the mean alone, from
    ``color_variance``, that of its colour (same shape).
    """
    irradiances = tuple(s.irradiance(color) for s, color in zip(surfaces, colors, strict=True))
    first = _FIRST_GUIDE if surfaces[0].penalty else _FIRST_GUIDE_WITHOUT_FEATURES
    smooth = tuple(
        np.maximum(_regress(image, first, s), 0) for image, s in zip(irradiances, surfaces, strict=True)
    )
    guides = _guides(smooth, irradiances, surfaces[0], color_variance)
    smooth = tuple(
        np.maximum(_regress(image, _SECOND_GUIDE, s, guide, guides.variance), 0)
        for image, guide, s in zip(irradiances, guides.images, surfaces, strict=True)
    )
    return _guides(smooth, irradiances, surfaces[0], color_variance)


def following_guides(
    colors: Halves, previous: Halves, surfaces: tuple[Surfaces, ...]
) -> tuple[Guides, Halves, Halves]:
    """Return guides as `first_guides`, at a part of its cost.

    ``previous`` are the halves of the previous frame's result, reprojected to this one, NaN where they have
    no value. They are the guide, filled by the first of `FOLLOWING_PILOTS`. Returns (guides, first pilot,
    filled previous frame), the last two as linear radiance.
    """
    irradiance_a, irradiance_b = (s.irradiance(color) for s, color in zip(surfaces, colors, strict=True))
    irradiances = irradiance_a, irradiance_b
    first_a, first_b = (
        s.color(_regress(image, FOLLOWING_PILOTS[0], s))
        for image, s in zip(irradiances, surfaces, strict=True)
    )
    filled_a, filled_b = (
        np.where(np.isfinite(image), np.maximum(image, 0), first).astype(np.float32)
        for image, first in zip(previous, (first_a, first_b), strict=True)
    )
    smooth = tuple(
        np.maximum((image - s.smooth_emission) / s.albedo, 0)
        for image, s in zip((filled_a, filled_b), surfaces, strict=True)
    )
    guides = _guides(smooth, irradiances, surfaces[0])
    return guides, (first_a, first_b), (filled_a, filled_b)


@dataclass
class PilotMaker:
    """Computes the pilots of both halves, or of the mean alone; ``color_variance`` as in `first_guides`.

    ``previous``, the filled frame of `following_guides`, is the guide of pilots of kind color if given.
    """

    colors: tuple[FloatImage, ...]
    surfaces: tuple[Surfaces, ...]
    guides: Guides
    color_variance: FloatImage | None = None
    previous: Halves | None = None

    def images(self, pilot: Pilot) -> tuple[FloatImage, ...]:
        """Return linear radiance, shape (height, width, 3), never negative, one image for each colour."""
        match pilot.kind:
            case "edges":
                return tuple(
                    along_edges(color, s.edges, pilot.radius, s.threads)
                    for color, s in zip(self.colors, self.surfaces, strict=True)
                )
            case "color":
                surfaces, guides = self._of_color
            case "features" | "guided":
                surfaces, guides = self.surfaces, self.guides
        return tuple(
            s.color(_regress(image, pilot, s, guide, guides.variance))
            for image, guide, s in zip(guides.irradiances, guides.images, surfaces, strict=True)
        )

    @cached_property
    def _of_color(self) -> tuple[tuple[Surfaces, ...], Guides]:
        surfaces = tuple(s.without_features() for s in self.surfaces)
        if self.previous is not None:
            return surfaces, _guides(self.previous, self.colors, surfaces[0])
        return surfaces, first_guides(self.colors, surfaces, self.color_variance)


def _guides(
    images: tuple[FloatImage, ...],
    irradiances: tuple[FloatImage, ...],
    surfaces: Surfaces,
    color_variance: FloatImage | None = None,
) -> Guides:
    guides = tuple(np.log(image + np.float32(_GUIDE_OFFSET)) for image in images)
    if len(guides) == 2:
        variance = (guides[0] - guides[1]) ** 2 / 2
    else:
        assert color_variance is not None
        squared = color_variance / surfaces.albedo**2
        variance = squared / (_SAMPLES_OF_GUIDE * (images[0] + np.float32(_GUIDE_OFFSET)) ** 2)
    variance = np.ascontiguousarray(variance, np.float32)
    variance = _core.box_mean(variance, _GUIDE_VARIANCE_RADIUS, surfaces.threads)
    return Guides(guides, variance + np.float32(_LEAST_GUIDE_VARIANCE), irradiances)


def _regress(
    image: FloatImage,
    pilot: Pilot,
    surfaces: Surfaces,
    guide: FloatImage | None = None,
    guide_variance: FloatImage | None = None,
) -> FloatImage:
    features, names, penalty = surfaces.features, surfaces.names, surfaces.penalty
    if pilot.with_position:
        features = np.concatenate((features, _positions(image.shape)), axis=2)
        names, penalty = (*names, "column", "row"), (*penalty, 0.0, 0.0)
    if pilot.k is None:
        return _core.regress(
            image, features, penalty, radius=pilot.radius, step=pilot.step, threads=surfaces.threads
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
        threads=surfaces.threads,
    )


def _positions(shape: tuple[int, ...]) -> FloatImage:
    rows, columns = np.indices(shape[:2], dtype=np.float32) / np.float32(_POSITION_SCALE_PIXELS)
    return np.stack((columns, rows), axis=2)
