"""How the network that blends pilots is trained: on what, how long, and from which weights."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from tungsten_dip.buffers.render_buffers import FloatArray, Indices
from tungsten_dip.cores import in_pair
from tungsten_dip.fit.candidates import Candidates
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.evidence import Cues, Evidence, with_best_baseline
from tungsten_dip.fit.model import Blend, Model, Weights
from tungsten_dip.fit.network.blend_network import BlendNetwork, Examples, first_weights
from tungsten_dip.fit.network.inputs import loss_weights, network_inputs
from tungsten_dip.fit.result import HistoryPoint
from tungsten_dip.fit.scoring.estimate import estimate_error, held_out_error
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.fit.standardisation import LARGEST_INPUT, standardisation_of
from tungsten_dip.progress import Progress

LEARNING_RATE = 1e-2
_WARM_UP_STEPS = 10
_POOL_PIXELS = 1 << 17
_POOL_PASSES = 4
"""Pixels that are drawn at a time, and how often they are used: to draw one takes half as long as to train on
it."""

_LEAST_BATCH = 64
_LEAST_COUNT = 1 << 12
_BATCH_GROWTH = 4 / 3
"""A step uses `_LEAST_BATCH` pixels where both halves have `_LEAST_COUNT`, and more on larger images, up to
the number of the preset, which images of about 512x288 pixels reach."""

_HISTORY_EVERY = 20
_PROBE_PIXELS = 1 << 15
"""Pixels that are not trained on: the error is estimated there."""

_PROBE_SHARE = 8
"""One pixel in this many at most is set aside."""

_STRANGE = 0.5
"""A model is not used on an image of which more than this part of an input is clipped at `LARGEST_INPUT`."""

_WARM_RATE = 0.3
"""A network that starts near its goal takes shorter steps: this part of the learning rate."""

_WARM_HISTORY_EVERY = 5
_WARM_PATIENCE = 3
_WARM_GAIN = 0.01
"""Training ends once so many estimates in a row have not lowered the error by this part."""


@dataclass(frozen=True)
class Start:
    """What a training starts from; ``warm`` if from the weights of a network fitted to another image."""

    evidence: Evidence
    examples: Examples
    blend: Blend
    weights: Weights
    warm: bool
    notes: tuple[str, ...] = ()


def start_of_training(evidence: Evidence, cues: Cues, seed: int, model: Model | None, members: int) -> Start:
    """Return the examples, and the weights of ``model`` or, if its image was too different, new ones.

    New weights are those of so many ``members`` (`fit.network.blend_network`).
    """
    inputs = network_inputs(evidence.layout, evidence.candidates, cues, evidence.threads)
    notes: tuple[str, ...] = ()
    if model is not None and model.blend is not None:
        model.blend.standardisation.apply(inputs, evidence.threads)
        far_out = [float((np.abs(image) >= LARGEST_INPUT).mean()) for image in np.moveaxis(inputs, 2, 0)]
        if max(far_out) <= _STRANGE:
            return _start(evidence, cues, inputs, model.blend, model.weights, warm=True)
        notes = ("the image is too unlike the model's: a new network is fitted",)
        evidence, cues = with_best_baseline(evidence, cues)
        inputs = network_inputs(evidence.layout, evidence.candidates, cues, evidence.threads)
    standardisation = standardisation_of(inputs, evidence.threads)
    standardisation.apply(inputs, evidence.threads)
    weights = first_weights(evidence.layout, seed, members)
    blend = Blend(evidence.layout, standardisation)
    return _start(evidence, cues, inputs, blend, weights, warm=False, notes=notes)


def _start(
    evidence: Evidence,
    cues: Cues,
    inputs: FloatArray,
    blend: Blend,
    weights: Weights,
    warm: bool,
    notes: tuple[str, ...] = (),
) -> Start:
    """Return the start with its examples, of which the candidates of its evidence are views."""
    pixels = inputs.shape[1]
    candidates = np.empty((2, pixels, len(evidence.candidates.all), 3), np.float32)

    def fill(half: int) -> None:
        for index, image in enumerate(evidence.candidates.of_half(half)):
            candidates[half, :, index] = image.reshape(pixels, 3)

    in_pair(fill, evidence.threads)
    target = np.concatenate([half.reshape(pixels, 3) for half in evidence.candidates.noisy[::-1]])
    weight = np.concatenate([weight.reshape(pixels, 1) for weight in loss_weights(cues)])
    examples = Examples(inputs.reshape(2 * pixels, -1), candidates.reshape(2 * pixels, -1, 3), target, weight)
    # Large images need gigabytes for each copy.
    shape = evidence.mean.shape
    noisy, *filtered = [(a.reshape(shape), b.reshape(shape)) for a, b in candidates.transpose(2, 0, 1, 3)]
    count = len(evidence.candidates.pilots)
    views = Candidates(noisy, tuple(filtered[:count]), tuple(filtered[count:]))
    return Start(replace(evidence, candidates=views), examples, blend, weights, warm, notes)


def _batches(examples: Examples, trained: Indices, size: int, rng: np.random.Generator) -> Iterator[Examples]:
    """Yield ``size`` of both halves' examples at a time, or as many as there are, without end.

    ``trained`` are the pixels that they are drawn from, with replacement. On small images every step uses
    less than in proportion, or the network would learn their noise: PSNR at 64x36 rises by 3 dB.
    """
    count, pixels = 2 * len(trained), len(examples.inputs) // 2
    size = min(size, count, max(_LEAST_BATCH, round(_LEAST_BATCH * (count / _LEAST_COUNT) ** _BATCH_GROWTH)))
    while True:
        half, index = np.divmod(rng.integers(count, size=max(_POOL_PIXELS, size)), len(trained))
        pool = examples.at(half * pixels + trained[index])
        for _ in range(_POOL_PASSES):
            for end in range(size, len(pool.inputs) + 1, size):
                yield pool.part(end - size, end)


@dataclass(frozen=True)
class _Probe:
    """Pixels by which a training is judged: the candidates there, and the examples of each half."""

    candidates: Candidates
    examples: tuple[Examples, Examples]
    scale: float
    threads: int

    def errors(self, network: BlendNetwork) -> tuple[float, float]:
        """Return the estimated error, and the error on the other half."""

        def of_half(half: int) -> FloatArray:
            return network.blend(self.examples[half].inputs, self.candidates.of_half(half))

        denoised = in_pair(of_half, self.threads)
        errors = estimate_error(self.candidates, self.scale, denoised)
        return float(errors.mean(dtype=np.float64)), held_out_error(self.candidates, denoised)


def _probe(start: Start, rng: np.random.Generator) -> tuple[_Probe, Indices]:
    """Set pixels aside; return them, and the others, which are trained on. Tiny images have but one set."""
    pixels = len(start.examples.inputs) // 2
    order = rng.permutation(pixels)
    probed = min(_PROBE_PIXELS, pixels // _PROBE_SHARE)
    probe, trained = (order[:probed], order[probed:]) if probed else (order, order)
    evidence, examples = start.evidence, start.examples
    of_halves = examples.of_half(0).at(probe), examples.of_half(1).at(probe)
    candidates = evidence.candidates.map(lambda image: image.reshape(-1, 3)[probe])
    return _Probe(candidates, of_halves, evidence.scale, evidence.threads), trained


@dataclass
class Training:
    """How far a training went."""

    steps_done: int = 0
    interrupted: bool = False
    history: list[HistoryPoint] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class _EarlyStopping:
    """The lowest error after a warm start, and the weights that have it."""

    error: float
    weights: Weights
    _since_gain: int = 0

    def record(self, step: int, error: float, network: BlendNetwork) -> None:
        """Take note of the error that the network has now. The first step is too small to tell of a gain."""
        if step > 1:
            self._since_gain = 0 if error < (1 - _WARM_GAIN) * self.error else self._since_gain + 1
        if error < self.error:
            self.error, self.weights = error, network.weights()

    @property
    def reached(self) -> bool:
        """Whether the error falls no further."""
        return self._since_gain >= _WARM_PATIENCE


def train(
    network: BlendNetwork,
    start: Start,
    settings: FitSettings,
    steps: int,
    batch_pixels: int,
    clock: Clock,
    progress: Progress,
) -> Training:
    """Train for ``steps`` steps, or fewer: within the time budget, to the target error, until Ctrl-C.

    Every step uses at most ``batch_pixels`` pixels, drawn at random (see `_batches`).

    After a warm start, training stops once the error of pixels that are not trained on, estimated from the
    halves, falls no further.
    """
    rng = np.random.default_rng(settings.seed)
    probe, trained = _probe(start, rng)
    batches = _batches(start.examples, trained, batch_pixels, rng)
    done = Training(notes=list(start.notes))
    every = _WARM_HISTORY_EVERY if start.warm else _HISTORY_EVERY
    spent_before = clock.share_spent()
    left = max(1 - spent_before, 1e-9)
    stopping = None
    if start.warm:
        error, held_out = probe.errors(network)
        done.history.append(HistoryPoint(clock.seconds(), 0, error))
        stopping = _EarlyStopping(held_out, network.weights())
    try:
        for step in range(1, steps + 1):
            rate = min(1.0, step / _WARM_UP_STEPS)
            # What the learning rate anneals over is what ends first: the steps or the budget.
            gone = max((step - 1) / steps, min((clock.share_spent() - spent_before) / left, 1.0))
            rate *= _WARM_RATE if start.warm else 0.5 + 0.5 * math.cos(math.pi * gone)
            network.step(next(batches), LEARNING_RATE * rate)
            done.steps_done = step
            if step % every != 0 and step != steps and step != 1:
                continue
            error, held_out = probe.errors(network)
            done.history.append(HistoryPoint(clock.seconds(), step, error))
            progress(step / steps, f"relMSE {error:.4g}")
            if stopping is not None:
                stopping.record(step, held_out, network)
            reason = _reason_to_stop(error, settings, clock, stopping)
            if reason is not None:
                done.notes.append(f"stopped at step {step}: {reason}")
                break
    except KeyboardInterrupt:
        done.interrupted = True
        done.notes.append(f"interrupted at step {done.steps_done}: the image is the one reached by then")
    if stopping is not None:
        network.load(stopping.weights)
    return done


def _reason_to_stop(
    error: float, settings: FitSettings, clock: Clock, stopping: _EarlyStopping | None
) -> str | None:
    if error <= (settings.target_error or -math.inf):
        return "the target error is reached"
    if clock.share_spent() > 1:
        return "the time budget is spent"
    if stopping is not None and stopping.reached:
        return "the error falls no further"
    return None
