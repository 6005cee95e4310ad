"""What is computed from an image before a network is fitted to it: its halves, its features, its pilots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from threading import Event

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.relmse import RELMSE_EPSILON
from tungsten_dip.buffers.render_buffers import (
    FEATURES,
    FloatImage,
    Halves,
    Indices,
    RenderBuffers,
    mean_of,
)
from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.exposure import exposure, scaled
from tungsten_dip.fit.fireflies import Limited, limit_fireflies
from tungsten_dip.fit.layout import Layout, Pilot
from tungsten_dip.fit.neighbours import mean_around
from tungsten_dip.fit.oidn import oidn_pilot
from tungsten_dip.fit.pilots import (
    DRAFT_PILOTS,
    FOLLOWING_PILOTS,
    Guides,
    PilotMaker,
    first_guides,
    following_guides,
)
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.fit.splitting import HalvedImage
from tungsten_dip.fit.stages import stage
from tungsten_dip.fit.surfaces import Surfaces, alpha_as_albedo, emission_of_halves, surfaces_of_halves
from tungsten_dip.progress import Progress

_ERROR_RADIUS = 8
_NEAR_RADIUS = 2
"""Radius of the window in which no sample may have hit anything, for a pixel to be empty space."""

_OUTLIER = 20.0
"""Squared errors are capped at so many times what those by a half itself are in the pixels around."""

_LEAST_CAP = 1e-3
"""Errors up to here are never capped as outliers."""

_BAND_ROWS = 64
"""Rows of all pilots that are sorted at a time: large images need gigabytes for each copy."""

_PILOTS_SHARE = 0.45
_DRAFT_SHARE = 0.7
"""Parts of a time budget after which no further pilot, or none of draft's, begins. Training gets the rest."""


@dataclass(frozen=True)
class Evidence:
    """What is computed from one image, its linear radiance multiplied by ``scale`` (a power of two).

    ``mean`` is the noisy image, without fireflies. ``features`` holds those of each half by name, shape
    (height, width). ``candidates`` holds both halves of the noisy image, of every pilot, of every extra
    pilot. ``baseline_errors`` is the relative squared difference, shape (height, width, 1), of the baseline
    pilot and the other half, in the pixels around each; ``denominators``, same shape, are what all squared
    errors of a half are relative to. Errors count up to ``caps``, which are made from the half itself, so
    that neither errors nor scores of a pixel depend on its value in the half that scores it.
    ``guide_variance`` is that of the pilots' guides (see `Guides`). ``gain`` is what gives back the radiance
    of fireflies (`fireflies.Limited`). ``halves_drawn`` and ``notes`` are those of the result (`FitResult`).
    """

    scale: float
    mean: FloatImage
    features: tuple[dict[str, FloatImage], ...]
    layout: Layout
    candidates: tuple[Halves, ...]
    baseline_errors: Halves
    denominators: Halves
    caps: Halves
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
            baseline_errors=cut(self.baseline_errors),
            denominators=cut(self.denominators),
            caps=cut(self.caps),
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
        _check_fits(layout, surfaces[0], len(extra_pilots) + (previous is not None))

    occupied = _occupied(halves, buffers, threads)
    guides, already_computed, filled = _guides(halves, surfaces, previous, scale, occupied)
    maker = PilotMaker(halves, surfaces, guides, previous=filled)
    budget = clock if layout is None else Clock()
    computed = _computed(maker, pilots, already_computed, occupied, budget, stage(progress, "pilots"))
    if filled is not None:
        extra_pilots.append(filled)

    candidates = (halves, *computed, *extra_pilots)
    denominators = _denominators(computed)
    if layout is None:
        baseline = _best(candidates, denominators)
        layout = Layout(surfaces[0].names, tuple(pilots[: len(computed)]), len(extra_pilots), baseline)
    caps = _caps(candidates, denominators, threads)
    baseline_errors = _baseline_errors(
        _errors(candidates[layout.baseline_index], halves, denominators), caps, threads
    )
    features = tuple({name: _feature(s, name) for name in layout.features} for s in surfaces)
    notes = (*_notes_on_features(buffers), *([limited.note] if limited.note else []), *image.notes)
    return Evidence(
        scale=scale,
        mean=mean,
        features=features,
        layout=layout,
        candidates=candidates,
        baseline_errors=baseline_errors,
        denominators=denominators,
        caps=caps,
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
        share = _DRAFT_SHARE if pilot in DRAFT_PILOTS else _PILOTS_SHARE
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


def pilots_of_all_samples(
    evidence: Evidence,
    buffers: RenderBuffers,
    settings: FitSettings,
    clock: Clock,
    given_up: Event | None = None,
) -> tuple[FloatImage, ...]:
    """Return the pilots of all samples, with less noisy features and guides than a half's.

    One image for each of ``evidence.candidates``, in the units of the evidence, shape (height, width, 3).
    None at all where the pilots of the halves have used up their share of the time budget, or once
    ``given_up`` is set.
    """
    if clock.share_spent() > _PILOTS_SHARE:
        return ()
    colors = (evidence.mean,)
    surfaces = surfaces_of_halves(buffers, colors, evidence.scale, evidence.threads)
    a, b = evidence.halves
    variance = np.float32(0.25) * (a - b) ** 2
    guides = first_guides(colors, surfaces, variance)
    guides = replace(guides, variance=evidence.guide_variance / np.float32(2))
    maker = PilotMaker(colors, surfaces, guides, variance)
    occupied = _occupied(evidence.halves, buffers, evidence.threads)
    computed = []
    for pilot in evidence.layout.pilots:
        if given_up is not None and given_up.is_set():
            return ()
        computed.append(maker.images(pilot)[0] * occupied)
    if settings.pilot == "oidn":
        computed.extend(oidn_pilot(buffers, colors, evidence.scale, evidence.threads))
    return (evidence.mean, *computed)


def with_best_baseline(evidence: Evidence) -> Evidence:
    """Return the same evidence with the pilot that is best on this image as the baseline."""
    candidates, denominators = evidence.candidates, evidence.denominators
    baseline = _best(candidates, denominators)
    errors = _errors(candidates[baseline], evidence.halves, denominators)
    baseline_errors = _baseline_errors(errors, evidence.caps, evidence.threads)
    return replace(
        evidence, layout=replace(evidence.layout, baseline_index=baseline), baseline_errors=baseline_errors
    )


def _best(candidates: Sequence[Halves], denominators: Halves) -> int:
    """Return the index of the candidate with the least error; the noisy halves, the first, do not count."""
    mean_errors = [
        sum(float(np.minimum(error, 1).mean()) for error in _errors(candidate, candidates[0], denominators))
        for candidate in candidates[1:]
    ]
    return 1 + int(np.argmin(mean_errors))


def _caps(candidates: Sequence[Halves], denominators: Halves, threads: int) -> Halves:
    """Return `Evidence.caps`, from the mean error of each half's candidates by that half itself."""

    def cap(half: int) -> FloatImage:
        errors = (
            relative_error(candidate[half], candidates[0][half], denominators[half])
            for candidate in candidates[1:]
        )
        mean = sum(errors, np.zeros_like(denominators[half])) / np.float32(len(candidates) - 1)
        around = _core.box_mean(mean, _ERROR_RADIUS, threads)
        return np.float32(_OUTLIER) * around + np.float32(_LEAST_CAP)

    return cap(0), cap(1)


def _baseline_errors(errors_of_baseline: Halves, caps: Halves, threads: int) -> Halves:
    """Return `Evidence.baseline_errors`."""
    a, b = (
        mean_around(np.minimum(error, cap), _ERROR_RADIUS, threads)
        for error, cap in zip(errors_of_baseline, caps, strict=True)
    )
    return a, b


def _check_fits(layout: Layout, surfaces: Surfaces, extra_count: int) -> None:
    unknown = [n for n in layout.features if n not in surfaces.names and n not in surfaces.left_out]
    if unknown:
        raise InputError(
            f"the model was fitted with {', '.join(unknown)}, which this input does not have; render it, or "
            f"fit without the model"
        )
    if layout.extra_count != extra_count:
        raise InputError(
            f"the model was fitted with {layout.extra_count} extra pilots (Open Image Denoise's image, the "
            f"previous frame), this input comes with {extra_count}; fit without the model"
        )


def _feature(surfaces: Surfaces, name: str) -> FloatImage:
    if name in surfaces.names:
        return surfaces.features[:, :, surfaces.names.index(name)]
    return np.broadcast_to(np.float32(surfaces.left_out[name]), surfaces.features.shape[:2])


def _occupied(halves: Halves, buffers: RenderBuffers, threads: int) -> FloatImage:
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


def _denominators(pilots: Sequence[Halves]) -> Halves:
    """Return the squared level of each half's last pilot or, where that is less, the median one, plus 0.01.

    Relative to itself, a pilot that spreads a lamp over dark pixels beside it would have little error there.
    """
    a, b = (np.empty((*half.shape[:2], 1), np.float32) for half in pilots[-1])
    for half, denominator in enumerate((a, b)):
        for first in range(0, len(denominator), _BAND_ROWS):
            band = slice(first, first + _BAND_ROWS)
            levels = [channel_mean(pilot[half][band]) for pilot in pilots]
            denominator[band] = np.minimum(levels[-1], np.median(levels, axis=0)) ** 2
        denominator += np.float32(RELMSE_EPSILON)
    return a, b


def _errors(pilot: Halves, halves: Halves, denominators: Halves) -> Halves:
    """How well each half's pilot predicts the other half."""
    a, b = (relative_error(*images) for images in zip(pilot, halves[::-1], denominators, strict=True))
    return a, b


def relative_error(image: FloatImage, other: FloatImage, denominator: FloatImage) -> FloatImage:
    """Return the mean squared difference of the channels over a denominator, shape (height, width, 1)."""
    error: FloatImage = channel_mean((image - other) ** 2) / denominator
    return error
