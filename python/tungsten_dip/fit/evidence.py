"""What is computed from an image before a network is fitted to it: its halves, its features, its pilots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.render_buffers import (
    FEATURES,
    FloatImage,
    Halves,
    Indices,
    RenderBuffers,
    mean_of,
)
from tungsten_dip.cores import thread_count
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.network.layout import Layout, Pilot
from tungsten_dip.fit.network.scoring import ErrorMeasure, best_candidate, error_measure
from tungsten_dip.fit.pilots.maker import Guides, PilotMaker, first_guides, following_guides
from tungsten_dip.fit.pilots.oidn import oidn_pilot
from tungsten_dip.fit.pilots.presets import DRAFT_PILOTS, FOLLOWING_PILOTS
from tungsten_dip.fit.pilots.surfaces import Surfaces, alpha_as_albedo, emission_of_halves, surfaces_of_halves
from tungsten_dip.fit.preparation.exposure import exposure, scaled
from tungsten_dip.fit.preparation.fireflies import Limited, limit_fireflies
from tungsten_dip.fit.preparation.splitting import HalvedImage
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.fit.stages import stage
from tungsten_dip.progress import Progress

_NEAR_RADIUS = 2
"""Radius of the window in which no sample may have hit anything, for a pixel to be empty space."""

PILOTS_SHARE = 0.45
_DRAFT_SHARE = 0.7
"""Parts of a time budget after which no further pilot, or none of draft's, begins. Training gets the rest."""


@dataclass(frozen=True)
class Evidence:
    """What is computed from one image, its linear radiance multiplied by ``scale`` (a power of two).

    ``mean`` is the noisy image, without fireflies. ``features`` holds those of each half by name, shape
    (height, width). ``candidates`` holds both halves of the noisy image, of every pilot, of every extra
    pilot, ``measure`` says how their errors are measured. ``baseline_errors``, shape (height, width, 1), are
    those of the baseline in the pixels around each. ``guide_variance`` is that of the pilots' guides (see
    `Guides`). ``gain`` is what gives back the radiance of fireflies (`fireflies.Limited`). ``halves_drawn``
    and ``notes`` are those of the result (`FitResult`).
    """

    scale: float
    mean: FloatImage
    features: tuple[dict[str, FloatImage], ...]
    layout: Layout
    candidates: tuple[Halves, ...]
    measure: ErrorMeasure
    baseline_errors: Halves
    guide_variance: FloatImage
    gain: FloatImage | None
    halves_drawn: bool
    notes: tuple[str, ...]
    threads: int

    @property
    def halves(self) -> Halves:
        """The noisy halves."""
        return self.candidates[0]

    def candidates_at(self, pixels: Indices) -> tuple[Halves, ...]:
        """Return the candidates at some pixels, shape (pixels, 3)."""
        return tuple((a.reshape(-1, 3)[pixels], b.reshape(-1, 3)[pixels]) for a, b in self.candidates)

    def rows(self, first: int, end: int) -> Evidence:
        """Return the evidence of some rows alone."""

        def cut(images: Halves) -> Halves:
            return images[0][first:end], images[1][first:end]

        return replace(
            self,
            mean=self.mean[first:end],
            features=tuple(
                {name: image[first:end] for name, image in features.items()} for features in self.features
            ),
            candidates=tuple(cut(candidate) for candidate in self.candidates),
            measure=self.measure.rows(first, end),
            baseline_errors=cut(self.baseline_errors),
            guide_variance=self.guide_variance[first:end],
            gain=None if self.gain is None else self.gain[first:end],
        )


def evidence_from_buffers(
    image: HalvedImage,
    settings: FitSettings,
    plan: Layout | Sequence[Pilot],
    clock: Clock,
    progress: Progress,
    previous: Halves | None,
) -> Evidence:
    """Compute the pilots of an image, as many as the time budget lets begin (one at least).

    ``plan`` is the pilots, or the layout of a fitted network, whose pilots are all computed. ``previous``
    is an extra pilot, NaN where it has no value, that guides the pilots as well.

    Raises InputError if the layout has a feature that is missing or another number of extra pilots.
    """
    layout, pilots = (plan, plan.pilots) if isinstance(plan, Layout) else (None, plan)
    buffers = image.buffers
    threads = thread_count(settings.threads)
    scale = exposure(buffers.color.mean)
    mean, limited = _without_fireflies(buffers, scale, threads)
    halves = limited.halves
    surfaces = surfaces_of_halves(buffers, halves, scale, threads)
    stage(progress, "features")(1.0, "features")
    extra_pilots: list[Halves] = []
    if settings.pilot == "oidn":
        a, b = oidn_pilot(buffers, halves, scale, threads)
        extra_pilots.append((a, b))
        stage(progress, "extra pilots")(1.0, "Open Image Denoise")
    if layout is not None:
        features_there = (*surfaces[0].names, *surfaces[0].left_out)
        layout.check_fits(features_there, len(extra_pilots) + (previous is not None))

    occupied = occupied_pixels(halves, buffers, threads)
    guides, already_computed, filled = _guides(halves, surfaces, previous, scale, occupied)
    maker = PilotMaker(halves, surfaces, guides, previous=filled)
    budget = clock if layout is None else Clock()
    computed = _computed(maker, pilots, already_computed, occupied, budget, stage(progress, "pilots"))
    if filled is not None:
        extra_pilots.append(filled)

    candidates = (halves, *computed, *extra_pilots)
    measure = error_measure(candidates, computed, threads)
    if layout is None:
        baseline = best_candidate(candidates, measure)
        layout = Layout(surfaces[0].names, tuple(pilots[: len(computed)]), len(extra_pilots), baseline)
    baseline_errors = measure.errors_around(candidates[layout.baseline_index], halves, threads)
    features = tuple({name: _feature(s, name) for name in layout.features} for s in surfaces)
    notes = (*_notes_on_features(buffers), *([limited.note] if limited.note else []), *image.notes)
    return Evidence(
        scale=scale,
        mean=mean,
        features=features,
        layout=layout,
        candidates=candidates,
        measure=measure,
        baseline_errors=baseline_errors,
        guide_variance=guides.variance,
        gain=limited.gain,
        halves_drawn=image.drawn,
        notes=notes,
        threads=threads,
    )


def _guides(
    halves: Halves,
    surfaces: tuple[Surfaces, ...],
    previous: Halves | None,
    scale: float,
    occupied: FloatImage,
) -> tuple[Guides, dict[Pilot, Halves], Halves | None]:
    """Return the guides, pilots that are computed along with them, and the previous frame, filled."""
    if previous is None:
        return first_guides(halves, surfaces), {}, None
    guides, first, filled = following_guides(halves, _scaled_halves(previous, scale), surfaces)
    return guides, {FOLLOWING_PILOTS[0]: _masked(first, occupied)}, _masked(filled, occupied)


def _computed(
    maker: PilotMaker,
    pilots: Sequence[Pilot],
    already_computed: dict[Pilot, Halves],
    occupied: FloatImage,
    clock: Clock,
    progress: Progress,
) -> list[Halves]:
    """Return all pilots, but those that the time budget does not allow any more; the first it always does."""
    computed: list[Halves] = []
    for index, pilot in enumerate(pilots):
        progress(index / len(pilots), f"pilot {index + 1}")
        share = _DRAFT_SHARE if pilot in DRAFT_PILOTS else PILOTS_SHARE
        if index > 0 and clock.share_spent() > share:
            break
        images = already_computed.get(pilot)
        computed.append(images or _masked(maker.images(pilot), occupied))
    return computed


def _without_fireflies(buffers: RenderBuffers, scale: float, threads: int) -> tuple[FloatImage, Limited]:
    """Return the mean and the halves, scaled, without fireflies."""
    color = buffers.color
    assert color.halves is not None
    half_a, half_b = (scaled(half, scale) for half in color.halves)
    emission = emission_of_halves(buffers, (half_a, half_b), scale)
    deviation = None if color.variance is None else scaled(np.sqrt(color.variance), scale)
    limited = limit_fireflies(half_a, half_b, threads, emission, deviation)
    if limited.gain is None:
        return scaled(color.mean, scale), limited
    return mean_of(limited.halves), limited


def _masked(images: Sequence[FloatImage], occupied: FloatImage) -> Halves:
    a, b = images
    return a * occupied, b * occupied


def _scaled_halves(halves: Halves, scale: float) -> Halves:
    """Return linear radiance in the units of the evidence."""
    a, b = (np.maximum(scaled(half, scale), 0) for half in halves)
    return a, b


def with_best_baseline(evidence: Evidence) -> Evidence:
    """Return the same evidence with the candidate that is best on this image as the baseline."""
    candidates, measure = evidence.candidates, evidence.measure
    baseline = best_candidate(candidates, measure)
    return replace(
        evidence,
        layout=replace(evidence.layout, baseline_index=baseline),
        baseline_errors=measure.errors_around(candidates[baseline], evidence.halves, evidence.threads),
    )


def _feature(surfaces: Surfaces, name: str) -> FloatImage:
    if name in surfaces.names:
        return surfaces.features[:, :, surfaces.names.index(name)]
    return np.broadcast_to(np.float32(surfaces.left_out[name]), surfaces.features.shape[:2])


def occupied_pixels(halves: Halves, buffers: RenderBuffers, threads: int) -> FloatImage:
    """Return 0 where no sample in the 5x5 pixels around hit anything or had radiance, else 1.

    Shape (height, width, 1), or (1, 1, 1) without depth. In black empty space, any radiance that filters
    spread there is visible.
    """
    if buffers.depth is None:
        return np.ones((1, 1, 1), np.float32)
    hit = (buffers.depth.mean > 0) | (halves[0] + halves[1] > 0).any(axis=2, keepdims=True)
    near = _core.box_mean(hit.astype(np.float32), _NEAR_RADIUS, threads) > 0
    return near.astype(np.float32)


def _notes_on_features(buffers: RenderBuffers) -> tuple[str, ...]:
    """Return a note on missing features, if there are any."""
    missing = [name for name in FEATURES if buffers.get(name) is None]
    if not missing:
        return ()
    alpha = alpha_as_albedo(buffers)
    instead = "" if alpha is None or np.ptp(alpha) == 0 else "; alpha takes the albedo's place"
    return (f"no {', '.join(missing)}: edges are found with less evidence{instead}",)
