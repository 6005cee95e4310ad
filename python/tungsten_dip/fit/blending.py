"""The presets draft, balanced and final: a small network blends pilots, trained across the halves.

The network's inputs (`inputs`) are those of one pixel of one half. It outputs the weights of a mean of the
candidates (the noisy pixel and the pilots), and is trained to predict the other half, as in Lehtinen et al.
2018, "Noise2Noise". The noise of the other half is independent: it adds a constant to the loss and does not
enter the image, whose mean is preserved but for errors so large that the loss bounds them (`blend_network`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Event
from types import TracebackType
from typing import Self

from tungsten_dip.buffers.render_buffers import FloatArray, FloatImage, Halves, RenderBuffers, mean_of
from tungsten_dip.cores import in_pair
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.evidence import Evidence, evidence_from_buffers
from tungsten_dip.fit.model import Model, source_sha256
from tungsten_dip.fit.network.blend_network import BlendNetwork
from tungsten_dip.fit.network.layout import Pilot
from tungsten_dip.fit.network.training import start_of_training, train
from tungsten_dip.fit.output.all_samples import pilots_of_all_samples
from tungsten_dip.fit.output.denoised import denoised_image, result_without_noise
from tungsten_dip.fit.pilots.presets import (
    BALANCED_PILOTS,
    DRAFT_PILOTS,
    FINAL_PILOTS,
    FOLLOWING_DRAFT_PILOTS,
    FOLLOWING_PILOTS,
)
from tungsten_dip.fit.preparation.splitting import with_independent_halves
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.fit.stages import stage
from tungsten_dip.interrupts import wait_in_short_turns
from tungsten_dip.progress import Progress

_LARGE_RADIUS = 18
"""Windows of a larger radius are left out where they would cover the whole image."""

_BATCH_PIXELS = 1 << 14
_SMALL_BATCH_PIXELS = 1 << 13
"""Pixels of a step, at most. The small batch is enough for the pilots of draft, and beside a previous frame;
with more of them the rims of lamps, few pixels, come out worse."""

STEPS_OF_ONE_NETWORK = 240
"""Steps of one network by itself: after fewer, walls are more blotched. The mean of several needs fewer."""


@dataclass(frozen=True)
class _Preset:
    pilots: tuple[Pilot, ...]
    steps: int
    batch_pixels: int = _BATCH_PIXELS
    members: int = 1
    following: tuple[Pilot, ...] = FOLLOWING_PILOTS
    all_samples: bool = True
    """Whether the pilots are computed from all samples, too."""


_PRESETS = {
    "draft": _Preset(
        DRAFT_PILOTS, 80, _SMALL_BATCH_PIXELS, following=FOLLOWING_DRAFT_PILOTS, all_samples=False
    ),
    "balanced": _Preset(BALANCED_PILOTS, 160, members=2),
    "final": _Preset(FINAL_PILOTS, 240, members=6),
}


def fit_blend(
    buffers: RenderBuffers,
    settings: FitSettings,
    progress: Progress,
    warm_start: Model | None = None,
    previous: Halves | None = None,
    refit_steps: int | None = None,
) -> FitResult:
    """Denoise sanitised buffers; see `tungsten_dip.fit.denoise`.

    ``refit_steps`` takes the place of the settings' iterations if the network of ``warm_start`` is trained
    further, not if a new one is fitted.

    ``previous`` are the halves of the previous frame's result, reprojected to this frame: linear radiance in
    the shape of the colour, NaN where they have no value. They are an extra pilot and a guide, with which
    fewer pilots are needed.

    Ctrl-C during the training or after it ends the fit early. The pilots of all samples are then used if they
    are complete, else given up: the image is made of the halves alone.
    """
    clock = Clock(settings.time_budget_s)
    unchanged = result_without_noise(buffers, settings, clock, progress)
    if unchanged is not None:
        return unchanged
    halved = with_independent_halves(buffers, settings.seed, settings.threads)
    following = previous is not None
    preset = _preset(settings, following)
    blend = None if warm_start is None else warm_start.blend
    plan = _pilots(buffers, settings, preset, following) if blend is None else blend.layout
    evidence = evidence_from_buffers(halved, settings, plan, clock, progress, previous)
    start = start_of_training(evidence, settings.seed, warm_start, preset.members)
    if start.warm and refit_steps is not None:
        settings = replace(settings, iterations=refit_steps)
    evidence = start.evidence
    network = BlendNetwork(
        start.weights,
        len(evidence.layout.inputs),
        evidence.layout.candidate_count,
        settings.device,
        evidence.threads,
    )

    def pilots_beside(given_up: Event) -> tuple[FloatImage, ...]:
        if not preset.all_samples:
            return ()
        return pilots_of_all_samples(evidence, halved.buffers, settings, clock, given_up)

    # Each network keeps one core busy; the pilots of all samples take what is left of all of them.
    with _AllSamplesPilots(pilots_beside) as beside:
        if evidence.threads == 1:
            beside.wait()
        steps = settings.iterations or preset.steps
        training = train(
            network, start, settings, steps, preset.batch_pixels, clock, stage(progress, "training")
        )
        try:
            if training.interrupted:
                beside.give_up()
            beside.wait()
        except KeyboardInterrupt:
            beside.give_up()
            training.interrupted = True
            training.notes.append(f"interrupted after the training of {training.steps_done} steps")
        all_samples_pilots = beside.result()
    if training.interrupted and preset.all_samples and not all_samples_pilots:
        training.notes.append("without the pilots of all samples: the image is made of the halves alone")
    inputs = start.examples.inputs.reshape(2, -1, len(evidence.layout.inputs))
    denoised, all_samples_blend = blended_images(network, inputs, evidence, all_samples_pilots)
    result = denoised_image(evidence, denoised, all_samples_blend, settings, clock)
    if not training.interrupted:
        progress(1.0, f"relMSE {result.estimated_relmse:.4g}")
    return replace(
        result,
        iterations=training.steps_done,
        model=Model(
            inputs=evidence.layout.inputs,
            weights=network.weights(),
            settings=settings,
            estimated_relmse=result.estimated_relmse,
            source_sha256=source_sha256(buffers),
            blend=start.blend,
        ),
        history=tuple(training.history),
        interrupted=training.interrupted,
        notes=(*result.notes, *training.notes),
    )


def _preset(settings: FitSettings, following: bool) -> _Preset:
    preset = _PRESETS[settings.preset]
    if preset.members > 1 and (following or settings.time_budget_s is not None):
        # A time budget, or the little time of a frame, is better spent on the steps of one network.
        preset = replace(preset, members=1, steps=STEPS_OF_ONE_NETWORK)
    if following:
        # The previous frame moved into place has no counterpart among the pilots of all samples.
        preset = replace(preset, pilots=preset.following, batch_pixels=_SMALL_BATCH_PIXELS, all_samples=False)
    return preset


def blends_all_samples(settings: FitSettings, following: bool) -> bool:
    """Whether the preset blends the pilots of all samples, too: never in a frame ``following`` another."""
    return _preset(settings, following).all_samples


def _pilots(
    buffers: RenderBuffers, settings: FitSettings, preset: _Preset, following: bool
) -> tuple[Pilot, ...]:
    """Return the preset's pilots, as far as the image is large enough, in the order of their use."""
    # One model of first order cannot stand for a whole image.
    largest = max(_LARGE_RADIUS, (max(buffers.width, buffers.height) - 1) // 2)
    pilots = tuple(pilot for pilot in preset.pilots if pilot.radius <= largest)
    if settings.time_budget_s is None or following:
        return pilots
    # Those of draft are enough by themselves where there is no time for others.
    return (*DRAFT_PILOTS, *(pilot for pilot in pilots if pilot not in DRAFT_PILOTS))


class _AllSamplesPilots:
    """The pilots of all samples, computed in a thread of its own from entering on.

    Leaving waits for the thread; an error gives its work up before.
    """

    def __init__(self, compute: Callable[[Event], tuple[FloatImage, ...]]) -> None:
        """``compute`` returns them, or none soon after its argument is set."""
        self._compute = compute
        self._given_up = Event()
        self._thread = ThreadPoolExecutor(1)

    def __enter__(self) -> Self:
        self._pending = self._thread.submit(self._compute, self._given_up)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self.give_up()
        self._thread.shutdown()

    def give_up(self) -> None:
        """Do without them unless they are complete."""
        self._given_up.set()

    def wait(self) -> None:
        """Wait for them. Raises the error of their computation."""
        wait_in_short_turns(self._pending)
        self._pending.result()

    def result(self) -> tuple[FloatImage, ...]:
        """Wait for them and return them, none if they were given up. Raises as `wait`."""
        self.wait()
        return self._pending.result()


def blended_images(
    network: BlendNetwork,
    inputs: FloatArray,
    evidence: Evidence,
    all_samples_pilots: Sequence[FloatImage],
) -> tuple[Halves, FloatImage | None]:
    """Return the network's blend of the candidates of both halves and, if given, of all samples.

    ``inputs`` are standardised, shape (2, height * width, inputs).
    """
    shape = evidence.mean.shape

    def blend(half: int, candidates: Sequence[FloatImage]) -> FloatImage:
        return network.blend(inputs[half], candidates).reshape(shape)

    denoised = in_pair(
        lambda h: blend(h, [candidate[h] for candidate in evidence.candidates]), evidence.threads
    )
    if not all_samples_pilots:
        return denoised, None
    return denoised, mean_of(in_pair(lambda h: blend(h, all_samples_pilots), evidence.threads))
