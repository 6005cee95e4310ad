"""The presets draft, balanced and final: a small network chooses among pilots, trained across the halves.

The network sees one pixel of one half: its planes (`planes`). It answers with the weights of a mean of the
pilots, and is trained to predict the other half, as in Lehtinen et al. 2018, "Noise2Noise". All this is
linear in the scored half, so noise adds a constant to the loss and nothing to the image: the mean is kept.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from threading import Event

import numpy as np

from tungsten_dip.buffers.model import Halves, RenderBuffers
from tungsten_dip.fit.evidence import evidence_from_buffers, pilots_of_all_samples
from tungsten_dip.fit.halves import of_both_halves
from tungsten_dip.fit.model import Model, source_sha256
from tungsten_dip.fit.outcome import result_from_fused, result_without_noise
from tungsten_dip.fit.pilots import (
    BALANCED_PILOTS,
    DRAFT_PILOTS,
    FINAL_PILOTS,
    FOLLOWING_DRAFT_PILOTS,
    FOLLOWING_PILOTS,
    Pilot,
)
from tungsten_dip.fit.pointwise import PointwiseNetwork
from tungsten_dip.fit.settings import FitResult, FitSettings
from tungsten_dip.fit.splitting import with_independent_halves
from tungsten_dip.fit.training import start_of_training, train
from tungsten_dip.progress import Progress, silent

_LARGE_RADIUS = 18
"""Windows of a larger radius are left out where they would cover the whole image."""


_BATCH_PIXELS = 1 << 14
_SMALL_BATCH_PIXELS = 1 << 13
"""Enough for the pilots of draft, and beside a previous frame; with more of them the rims of lamps, few
pixels, come out worse."""


@dataclass(frozen=True)
class _Preset:
    pilots: tuple[Pilot, ...]
    steps: int
    batch_pixels: int = _BATCH_PIXELS
    following: tuple[Pilot, ...] = FOLLOWING_PILOTS


_PRESETS = {
    "draft": _Preset(DRAFT_PILOTS, 80, _SMALL_BATCH_PIXELS, FOLLOWING_DRAFT_PILOTS),
    "balanced": _Preset(BALANCED_PILOTS, 240),
    "final": _Preset(FINAL_PILOTS, 240),
}


def fit_fusion(
    buffers: RenderBuffers,
    settings: FitSettings,
    progress: Progress = silent,
    candidates: Sequence[Halves] = (),
    warm_start: Model | None = None,
    previous: Halves | None = None,
) -> FitResult:
    """Denoise sanitised buffers; see `tungsten_dip.fit.denoise`."""
    started = time.perf_counter()
    preset = _PRESETS[settings.preset]
    if previous is not None:
        preset = _Preset(preset.following, preset.steps, _SMALL_BATCH_PIXELS)
    pilots = preset.pilots
    # One model of first order cannot stand for a whole image.
    largest = max(_LARGE_RADIUS, (max(buffers.width, buffers.height) - 1) // 2)
    pilots = tuple(pilot for pilot in pilots if pilot.radius <= largest)
    if settings.time_budget_s is not None and previous is None:
        # Those of draft are enough by themselves where there is no time for others.
        pilots = (*DRAFT_PILOTS, *(pilot for pilot in pilots if pilot not in DRAFT_PILOTS))
    asked = pilots if warm_start is None or warm_start.layout is None else warm_start.layout
    same = result_without_noise(buffers, settings, started)
    if same is not None:
        progress(1.0, "no noise")
        return same
    buffers, candidates, notes = with_independent_halves(
        buffers, tuple(candidates), settings.seed, settings.threads
    )
    drawn = bool(notes)
    evidence = evidence_from_buffers(buffers, settings, asked, candidates, started, progress, previous)
    threads = evidence.threads
    start = start_of_training(evidence, settings.seed, warm_start)
    evidence = start.evidence
    network = PointwiseNetwork(
        start.weights, len(evidence.layout.planes), evidence.layout.choices, settings.device
    )
    given_up = Event()
    # The network keeps one core busy; the pilots of all samples take what is left of all of them.
    with ThreadPoolExecutor(1) as beside:
        whole_pilots = beside.submit(
            lambda: (
                pilots_of_all_samples(evidence, buffers, settings, started, given_up)
                if previous is None
                else ()
            )
        )
        try:
            if threads == 1:
                wait([whole_pilots])
            steps = settings.iterations or preset.steps
            training = train(network, start, settings, steps, preset.batch_pixels, started, progress)
        except BaseException:
            given_up.set()
            raise
        if training.interrupted:
            given_up.set()
        try:
            images = whole_pilots.result()
        except KeyboardInterrupt:
            given_up.set()
            images = ()
            training.interrupted = True
            training.notes.append("interrupted: the image is made of the halves alone")
    shape = evidence.mean.shape
    halves = [start.examples.of_half(half) for half in (0, 1)]
    fused = of_both_halves(lambda half: network.fuse(halves[half]).reshape(shape), threads)
    whole = None
    if images:
        by_a, by_b = of_both_halves(lambda half: network.fuse(halves[half], images).reshape(shape), threads)
        whole = np.float32(0.5) * (by_a + by_b)
    result = result_from_fused(
        evidence,
        fused,
        whole,
        settings,
        started,
        training.steps_done,
        training.history,
        [*notes, *training.notes],
    )
    model = Model(
        kind="pointwise",
        planes=evidence.layout.planes,
        weights=network.weights(),
        settings=settings,
        estimated_relmse=result.estimated_relmse,
        source_sha256=source_sha256(buffers),
        layout=evidence.layout,
        standardisation=start.standardisation,
    )
    if not training.interrupted:
        progress(1.0, f"relMSE {result.estimated_relmse:.4g}")
    return replace(result, model=model, halves_drawn=drawn, interrupted=training.interrupted)
