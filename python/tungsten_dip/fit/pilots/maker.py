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
from tungsten_dip.buffers.render_buffers import FloatImage
from tungsten_dip.fit.layout import Pilot
from tungsten_dip.fit.pilots.surfaces import Surfaces, along_edges

_POSITION_SCALE_PIXELS = 20.0
_GUIDE_OFFSET = 0.05
"""Guides are log(irradiance + offset), of radiance for pilots of kind color: far below the offset it is
absolute differences that are visible, not relative ones."""

_GUIDE_VARIANCE_RADIUS = 3
_LEAST_GUIDE_VARIANCE = 1e-5

_GUIDED_SIGMA = 3
_GUIDED_SIGMA_ACROSS = 0.2
"""Standard deviations, in pixels, of the mean along edges that guided pilots become: the features and guides
of single pixels leave edges frayed, such as bars before a bright sky. Across edges nothing is averaged."""

_SAMPLES_OF_GUIDE = 12
"""About how many independent pixels a guide of all samples averages: no second half is left to estimate its
noise, which is taken to be that of the image divided by this."""


_FIRST_GUIDE = Pilot("features", 3)
_FIRST_GUIDE_WITHOUT_FEATURES = Pilot("features", 1)
"""Without features, a window blurs every edge within it."""

_SECOND_GUIDE = Pilot("guided", 8, step=2, k=1.0)
"""Guided by the first, it is the guide of pilots."""


@dataclass(frozen=True)
class Guides:
    """What guided pilots compare and denoise, one image for each half or for the mean, (height, width, 3).

    ``images`` are smoothed log irradiance, or log radiance for pilots of kind color. ``variance`` is
    that of one of them, ``irradiances`` the noisy irradiance (or radiance) that is regressed.
    """

    images: tuple[FloatImage, ...]
    variance: FloatImage
    irradiances: tuple[FloatImage, ...]


def guides_of_colors(
    colors: tuple[FloatImage, ...],
    surfaces: tuple[Surfaces, ...],
    threads: int,
    color_variance: FloatImage | None = None,
) -> Guides:
    """Return the guides of the two halves, or of the mean alone.

    The variance of the guides is estimated from the difference of the halves' or, for the mean alone, from
    ``color_variance``, that of its colour (same shape).
    """
    irradiances = tuple(s.irradiance(color) for s, color in zip(surfaces, colors, strict=True))
    first = _FIRST_GUIDE if surfaces[0].names else _FIRST_GUIDE_WITHOUT_FEATURES
    smooth = tuple(
        np.maximum(_regress(image, first, s, threads), 0)
        for image, s in zip(irradiances, surfaces, strict=True)
    )
    guides = _guides(smooth, irradiances, surfaces, threads, color_variance)
    smooth = tuple(
        np.maximum(_regress(image, _SECOND_GUIDE, s, threads, guide, guides.variance), 0)
        for image, guide, s in zip(irradiances, guides.images, surfaces, strict=True)
    )
    return _guides(smooth, irradiances, surfaces, threads, color_variance)


@dataclass
class PilotMaker:
    """Computes pilots of the two halves, or of the mean alone with the ``color_variance`` of its noise."""

    colors: tuple[FloatImage, ...]
    surfaces: tuple[Surfaces, ...]
    guides: Guides
    threads: int
    color_variance: FloatImage | None = None

    def images(self, pilot: Pilot) -> tuple[FloatImage, ...]:
        """Return linear radiance, shape (height, width, 3), never negative, one image for each colour."""
        match pilot.kind:
            case "edges":
                return tuple(
                    along_edges(color, s.edges, pilot.radius, self.threads)
                    for color, s in zip(self.colors, self.surfaces, strict=True)
                )
            case "color":
                surfaces, guides = self._of_color
            case "features" | "guided":
                surfaces, guides = self.surfaces, self.guides
        lit = tuple(
            s.reflected(_regress(image, pilot, s, self.threads, guide, guides.variance))
            for image, guide, s in zip(guides.irradiances, guides.images, surfaces, strict=True)
        )
        if pilot.kind == "guided":
            lit = tuple(
                along_edges(image, s.edges, _GUIDED_SIGMA, self.threads, across=_GUIDED_SIGMA_ACROSS)
                for image, s in zip(lit, surfaces, strict=True)
            )
        return tuple(image + s.smooth_emission for image, s in zip(lit, surfaces, strict=True))

    @cached_property
    def _of_color(self) -> tuple[tuple[Surfaces, ...], Guides]:
        surfaces = tuple(s.without_features() for s in self.surfaces)
        return surfaces, guides_of_colors(self.colors, surfaces, self.threads, self.color_variance)


def _guides(
    images: tuple[FloatImage, ...],
    irradiances: tuple[FloatImage, ...],
    surfaces: tuple[Surfaces, ...],
    threads: int,
    color_variance: FloatImage | None = None,
) -> Guides:
    """Return guides made of smooth images of the irradiances."""
    guides = tuple(np.log(image + np.float32(_GUIDE_OFFSET)) for image in images)
    if color_variance is None:
        guide_a, guide_b = guides
        variance = (guide_a - guide_b) ** 2 / 2
    else:
        squared = color_variance / surfaces[0].albedo ** 2
        variance = squared / (_SAMPLES_OF_GUIDE * (images[0] + np.float32(_GUIDE_OFFSET)) ** 2)
    variance = np.ascontiguousarray(variance, np.float32)
    variance = _core.box_mean(variance, _GUIDE_VARIANCE_RADIUS, threads)
    return Guides(guides, variance + np.float32(_LEAST_GUIDE_VARIANCE), irradiances)


def _regress(
    image: FloatImage,
    pilot: Pilot,
    surfaces: Surfaces,
    threads: int,
    guide: FloatImage | None = None,
    guide_variance: FloatImage | None = None,
) -> FloatImage:
    features, penalty = surfaces.features, surfaces.guided_penalty
    if pilot.k is None:
        penalty, guide, guide_variance = surfaces.penalty, None, None
    if pilot.with_position:
        features = np.concatenate((features, _positions(image.shape)), axis=2)
        penalty = (*penalty, 0.0, 0.0)
    return _core.regress(
        image,
        features,
        penalty,
        guide,
        guide_variance,
        radius=pilot.radius,
        step=pilot.step,
        k=pilot.k or 1.0,  # of no use without a guide
        threads=threads,
    )


def _positions(shape: tuple[int, ...]) -> FloatImage:
    rows, columns = np.indices(shape[:2], dtype=np.float32) / np.float32(_POSITION_SCALE_PIXELS)
    return np.stack((columns, rows), axis=2)
