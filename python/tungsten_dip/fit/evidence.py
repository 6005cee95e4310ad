"""What is computed from an image before a network is fitted to it: its halves, its features, its pilots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.render_buffers import (
    FEATURES,
    FloatImage,
    Halves,
    RenderBuffers,
    mean_of,
)
from tungsten_dip.fit.candidates import Candidates
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.layout import Layout, Pilot
from tungsten_dip.fit.pilots.maker import PilotMaker, guides_of_colors
from tungsten_dip.fit.pilots.oidn import oidn_pilot
from tungsten_dip.fit.pilots.surfaces import Surfaces, alpha_as_albedo, emission_of_halves, surfaces_of_colors
from tungsten_dip.fit.preparation.exposure import exposure, scaled
from tungsten_dip.fit.preparation.fireflies import Limited, limit_fireflies
from tungsten_dip.fit.preparation.splitting import HalvedImage
from tungsten_dip.fit.presets import DRAFT_PILOTS
from tungsten_dip.fit.scoring.measure import ErrorMeasure, best_candidate, error_measure
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

    ``mean`` is the noisy image, without fireflies. ``light`` is what the samples of each half saw directly of
    lights, shape (height, width, 1); None if that is not known of each. ``guide_variance`` is that of the
    pilots' guides (see `Guides`). ``gain`` is what gives back the radiance of fireflies
    (`fireflies.Limited`). ``halves_drawn`` and ``notes`` are those of the result (`FitResult`).
    """

    scale: float
    mean: FloatImage
    layout: Layout
    candidates: Candidates
    light: Halves | None
    guide_variance: FloatImage
    gain: FloatImage | None
    halves_drawn: bool
    notes: tuple[str, ...]
    threads: int


@dataclass(frozen=True)
class Cues:
    """What the inputs of a network and the weights of its loss are computed from, beside the candidates.

    ``features`` holds those of each half by name, shape (height, width), ``measure`` says how the errors of
    candidates are measured. ``baseline_errors``, shape (height, width, 1), are those of the baseline in the
    pixels around each.
    """

    features: tuple[dict[str, FloatImage], dict[str, FloatImage]]
    measure: ErrorMeasure
    baseline_errors: Halves

    def rows(self, first: int, end: int) -> Cues:
        """Return those of some rows alone."""
        features_a, features_b = (
            {name: image[first:end] for name, image in features.items()} for features in self.features
        )
        errors_a, errors_b = self.baseline_errors
        return Cues(
            (features_a, features_b),
            self.measure.rows(first, end),
            (errors_a[first:end], errors_b[first:end]),
        )


def evidence_from_buffers(
    image: HalvedImage,
    plan: Layout | Sequence[Pilot],
    clock: Clock,
    progress: Progress,
    *,
    threads: int,
    with_oidn: bool = False,
    previous: Halves | None = None,
) -> tuple[Evidence, Cues]:
    """Compute the pilots of an image, as many as the time budget lets begin (one at least).

    ``plan`` is the pilots, or the layout of a fitted network, whose pilots are all computed. Extra pilots are
    the image of Open Image Denoise, if ``with_oidn``, and the ``previous`` frame: halves of a result, NaN
    where they have no value, which the first pilot fills.

    Raises InputError if the layout has a feature that is missing or another number of extra pilots.
    """
    layout, pilots = (plan, plan.pilots) if isinstance(plan, Layout) else (None, plan)
    buffers = image.buffers
    scale = exposure(buffers.color)
    mean, limited = _without_fireflies(image, scale, threads)
    halves = limited.halves
    surfaces = surfaces_of_colors(buffers, halves, scale, threads)
    stage(progress, "features")(1.0, "features")
    notes = _notes_on_features(buffers)
    extra_pilots: list[Halves] = []
    if with_oidn:
        a, b = oidn_pilot(buffers, halves, threads)
        extra_pilots.append((a, b))
        stage(progress, "extra pilots")(1.0, "Open Image Denoise")
    if layout is not None:
        features_there = (*surfaces[0].names, *surfaces[0].left_out)
        layout.check_fits(features_there, len(extra_pilots) + (previous is not None))
        notes += layout.notes_on_features(features_there)

    occupied = occupied_pixels(halves, buffers, threads)
    guides = guides_of_colors(halves, surfaces, threads)
    maker = PilotMaker(halves, surfaces, guides, threads)
    budget = clock if layout is None else Clock()
    computed = _computed(maker, pilots, occupied, budget, stage(progress, "pilots"))
    if previous is not None:
        extra_pilots.append(_filled(previous, scale, computed[0], occupied))

    candidates = Candidates(halves, tuple(computed), tuple(extra_pilots))
    measure = error_measure(candidates, threads)
    if layout is None:
        baseline = best_candidate(candidates, measure)
        layout = Layout(surfaces[0].names, tuple(pilots[: len(computed)]), len(extra_pilots), baseline)
    features_a, features_b = ({name: _feature(s, name) for name in layout.features} for s in surfaces)
    evidence = Evidence(
        scale=scale,
        mean=mean,
        layout=layout,
        candidates=candidates,
        light=_light(image, halves, scale),
        guide_variance=guides.variance,
        gain=limited.gain,
        halves_drawn=image.drawn,
        notes=(*notes, *([limited.note] if limited.note else []), *image.notes),
        threads=threads,
    )
    cues = Cues(
        (features_a, features_b),
        measure,
        measure.errors_around(candidates.all[layout.baseline_index], halves, threads),
    )
    return evidence, cues


def _computed(
    maker: PilotMaker, pilots: Sequence[Pilot], occupied: FloatImage, clock: Clock, progress: Progress
) -> list[Halves]:
    """Return all pilots, but those that the time budget does not allow any more; the first it always does."""
    computed: list[Halves] = []
    for index, pilot in enumerate(pilots):
        progress(index / len(pilots), f"pilot {index + 1}")
        share = _DRAFT_SHARE if pilot in DRAFT_PILOTS else PILOTS_SHARE
        if index > 0 and clock.share_spent() > share:
            break
        a, b = maker.images(pilot)
        computed.append((a * occupied, b * occupied))
    return computed


def _filled(previous: Halves, scale: float, instead: Halves, occupied: FloatImage) -> Halves:
    """Return linear radiance in the units of the evidence, from a pilot ``instead`` where it has no value."""
    a, b = (
        np.where(np.isfinite(image), np.maximum(scaled(image, scale), 0) * occupied, pilot)
        for image, pilot in zip(previous, instead, strict=True)
    )
    return a, b


def _without_fireflies(image: HalvedImage, scale: float, threads: int) -> tuple[FloatImage, Limited]:
    """Return the mean and the halves, scaled, without fireflies."""
    color = image.buffers.color
    half_a, half_b = (scaled(half, scale) for half in image.halves)
    emission = emission_of_halves(image.buffers, (half_a, half_b), scale)
    deviation = None if color.variance is None else scaled(np.sqrt(color.variance), scale)
    limited = limit_fireflies(half_a, half_b, threads, emission, deviation)
    if limited.gain is None:
        return scaled(color.mean, scale), limited
    return mean_of(limited.halves), limited


def _light(image: HalvedImage, halves: Halves, scale: float) -> Halves | None:
    albedo = image.buffers.albedo
    if albedo is None or albedo.halves is None or image.drawn:
        return None
    emission = emission_of_halves(image.buffers, halves, scale)
    return None if emission is None else (channel_mean(emission[0]), channel_mean(emission[1]))


def with_best_baseline(evidence: Evidence, cues: Cues) -> tuple[Evidence, Cues]:
    """Return the same with the candidate that is best on this image as the baseline."""
    candidates, measure = evidence.candidates, cues.measure
    baseline = best_candidate(candidates, measure)
    errors = measure.errors_around(candidates.all[baseline], candidates.noisy, evidence.threads)
    layout = replace(evidence.layout, baseline_index=baseline)
    return replace(evidence, layout=layout), replace(cues, baseline_errors=errors)


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
