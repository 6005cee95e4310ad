"""The presets draft, balanced and final: a small network blends pilots, trained across the halves.

The network's inputs (`inputs`) are those of one pixel of one half. It outputs the weights of a mean of the
candidates (the noisy pixel and the pilots), and is trained to predict the other half, as in Lehtinen et al.
2018, "Noise2Noise". The noise of the other half is independent: it adds a constant to the loss and does not
enter the image, whose mean is preserved but for errors so large that the loss bounds them (`blend_network`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Event
from types import TracebackType
from typing import Self

from tungsten_dip.buffers.render_buffers import FloatArray, FloatImage, Halves, RenderBuffers, mean_of
from tungsten_dip.cores import in_pair, thread_count
from tungsten_dip.fit.candidates import Candidates
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.evidence import evidence_from_buffers
from tungsten_dip.fit.model import Model, source_sha256
from tungsten_dip.fit.network.blend_network import BlendNetwork
from tungsten_dip.fit.network.training import Training, start_of_training, train
from tungsten_dip.fit.output.all_samples import pilots_of_all_samples
from tungsten_dip.fit.output.denoised import denoised_image, image_without_noise
from tungsten_dip.fit.preparation.splitting import with_independent_halves
from tungsten_dip.fit.presets import pilots_for_size, recipe_of, steps_for_size
from tungsten_dip.fit.result import DenoisedImage, FitResult
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.fit.stages import stage
from tungsten_dip.interrupts import interrupts_as_requests, wait_in_short_turns
from tungsten_dip.progress import Progress

_FINISHING = "interrupted: the image is being made of what was reached; press Ctrl-C again to give it up"


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
    the shape of the colour, NaN where they have no value. They are an extra pilot, with which fewer others
    are needed.

    Ctrl-C during the training or after it ends the fit early. The pilots of all samples are then used if they
    are complete, else given up: the image is made of the halves alone. A second one while the image is made
    ends the process.
    """
    clock, threads = Clock(settings.time_budget_s), thread_count(settings.threads)
    unchanged = image_without_noise(buffers, threads)
    if unchanged is not None:
        progress(1.0, "no noise")
        return result_from_image(unchanged, settings, clock)
    halved = with_independent_halves(buffers, settings.seed, threads)
    recipe = recipe_of(settings, following=previous is not None)
    blend = None if warm_start is None else warm_start.blend
    plan = pilots_for_size(recipe.pilots, buffers.width, buffers.height) if blend is None else blend.layout
    with_oidn = settings.pilot == "oidn"
    evidence, cues = evidence_from_buffers(
        halved, plan, clock, progress, threads=threads, with_oidn=with_oidn, previous=previous
    )
    start = start_of_training(evidence, cues, settings.seed, warm_start, recipe.members)
    evidence = start.evidence
    del cues  # Large images need gigabytes for them.
    if start.warm and refit_steps is not None:
        settings = replace(settings, iterations=refit_steps)
    network = BlendNetwork(evidence.layout, start.weights, settings.device, threads)

    def pilots_beside(given_up: Event) -> tuple[FloatImage, ...]:
        if not recipe.all_samples:
            return ()
        return pilots_of_all_samples(evidence, halved.buffers, clock, with_oidn=with_oidn, given_up=given_up)

    with _AllSamplesPilots(pilots_beside) as beside:
        # Each network keeps one core busy; these pilots take what is left of all of them.
        if threads == 1:
            beside.result()
        steps = settings.iterations or steps_for_size(recipe.steps, buffers.width, buffers.height)
        training = train(
            network, start, settings, steps, recipe.batch_pixels, clock, stage(progress, "training")
        )
        all_samples_pilots = beside.result_after(training)
    if training.interrupted and recipe.all_samples and not all_samples_pilots:
        training.notes.append("without the pilots of all samples: the image is made of the halves alone")
    with interrupts_as_requests(_FINISHING) as requested:
        inputs = start.examples.inputs.reshape(2, -1, len(evidence.layout.inputs))
        blended = blended_images(network, inputs, evidence.candidates, all_samples_pilots, threads)
        image = denoised_image(evidence, *blended)
        model = Model(
            inputs=evidence.layout.inputs,
            weights=network.weights(),
            settings=settings,
            estimated_relmse=image.estimated_relmse,
            source_sha256=source_sha256(buffers),
            blend=start.blend,
        )
    training.interrupted |= requested()
    if not training.interrupted:
        progress(1.0, f"relMSE {image.estimated_relmse:.4g}")
    return replace(
        result_from_image(image, settings, clock, evidence.halves_drawn, model),
        iterations=training.steps_done,
        history=tuple(training.history),
        interrupted=training.interrupted,
        notes=(*image.notes, *training.notes),
    )


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

    def result(self) -> tuple[FloatImage, ...]:
        """Wait for them and return them, none if given up. Raises the error of their computation."""
        wait_in_short_turns(self._pending)
        return self._pending.result()

    def result_after(self, training: Training) -> tuple[FloatImage, ...]:
        """Return them as `result`, if they are complete at the end of an interrupted training, else none.

        Ctrl-C in here interrupts the training, too.
        """
        try:
            if training.interrupted:
                self.give_up()
            return self.result()
        except KeyboardInterrupt:
            self.give_up()
            if not training.interrupted:
                training.interrupted = True
                training.notes.append(f"interrupted after the training of {training.steps_done} steps")
            return self.result()


def result_from_image(
    image: DenoisedImage,
    settings: FitSettings,
    clock: Clock,
    halves_drawn: bool = False,
    model: Model | None = None,
) -> FitResult:
    """Return the result that consists of these images; it tells of no training."""
    return FitResult(
        color=image.color,
        settings=settings,
        seconds=clock.seconds(),
        iterations=0,
        error=image.error,
        estimated_relmse=image.estimated_relmse,
        halves=image.halves,
        gain=image.gain,
        halves_drawn=halves_drawn,
        model=model,
        notes=image.notes,
    )


def blended_images(
    network: BlendNetwork,
    inputs: FloatArray,
    candidates: Candidates,
    all_samples_pilots: Sequence[FloatImage],
    threads: int,
) -> tuple[Halves, FloatImage | None]:
    """Return the network's blend of the candidates of both halves and, if given, of all samples.

    ``inputs`` are standardised, shape (2, height * width, inputs).
    """
    shape = candidates.noisy[0].shape

    def blend(half: int, images: Sequence[FloatImage]) -> FloatImage:
        return network.blend(inputs[half], images).reshape(shape)

    denoised = in_pair(lambda h: blend(h, candidates.of_half(h)), threads)
    if not all_samples_pilots:
        return denoised, None
    return denoised, mean_of(in_pair(lambda h: blend(h, all_samples_pilots), threads))
