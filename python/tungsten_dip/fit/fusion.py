"""The presets draft, balanced and final: a small network chooses among pilots, trained across the halves.

The network sees one pixel of one half: its planes (`evidence`). It answers with the weights of a mean of the
pilots, and is trained to predict the other half, as in Lehtinen et al. 2018, "Noise2Noise". All this is
linear in the scored half, so noise adds a constant to the loss and nothing to the image: the mean is kept.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from threading import Event

import numpy as np
import torch
from torch import Tensor, nn

from tungsten_dip.buffers.model import FloatImage, RenderBuffers
from tungsten_dip.fit.device import compute_device
from tungsten_dip.fit.evidence import (
    Array,
    Halves,
    Indices,
    evidence_from_buffers,
    pilots_of_all_samples,
    result_from_fused,
)
from tungsten_dip.fit.model import Model, Weights, check_settings, source_sha256
from tungsten_dip.fit.pilots import BALANCED_PILOTS, DRAFT_PILOTS, FINAL_PILOTS, FOLLOWING_PILOTS, Pilot
from tungsten_dip.fit.settings import FitResult, FitSettings
from tungsten_dip.fit.training import (
    ADAM_BETAS,
    ADAM_EPSILON,
    LEAKY_SLOPE,
    Examples,
    start_of_training,
    train,
)
from tungsten_dip.progress import Progress, silent

_CHUNK_PIXELS = 1 << 18

_LARGE_RADIUS = 18
"""Windows of a larger radius are left out where they would cover the whole image."""


@dataclass(frozen=True)
class _Preset:
    pilots: tuple[Pilot, ...]
    steps: int


_PRESETS = {
    "draft": _Preset(DRAFT_PILOTS, 80),
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
    if warm_start is not None:
        check_settings(warm_start, settings)
    pilots = preset.pilots if previous is None else FOLLOWING_PILOTS
    # One model of first order cannot stand for a whole image.
    largest = max(_LARGE_RADIUS, (max(buffers.width, buffers.height) - 1) // 2)
    pilots = tuple(pilot for pilot in pilots if pilot.radius <= largest)
    if settings.time_budget_s is not None and previous is None:
        # Those of draft are enough by themselves where there is no time for others.
        pilots = (*DRAFT_PILOTS, *(pilot for pilot in pilots if pilot not in DRAFT_PILOTS))
    asked = pilots if warm_start is None or warm_start.layout is None else warm_start.layout
    evidence = evidence_from_buffers(buffers, settings, asked, candidates, started, progress, previous)
    if isinstance(evidence, FitResult):
        return evidence
    start = start_of_training(evidence, settings.seed, warm_start)
    evidence = start.evidence
    threads = settings.threads or os.cpu_count() or 1
    given_up = Event()
    # The network is too small to share: on a busy machine threads would only wait for one another. While one
    # of them trains it, the others make the pilots of all samples.
    with compute_device(settings, most_threads=1) as device, ThreadPoolExecutor(1) as beside:
        whole_pilots = beside.submit(
            lambda: (
                pilots_of_all_samples(evidence, buffers, settings, started, max(threads - 1, 1), given_up)
                if previous is None
                else ()
            )
        )
        if threads == 1:
            wait([whole_pilots])
        network = _TorchNetwork(start.weights, start.examples, device)
        steps = settings.iterations or preset.steps
        training = train(network, start, settings, steps, started, progress)
        if training.interrupted:
            given_up.set()
        shape = evidence.mean.shape
        fused = network.fuse_all(0).reshape(shape), network.fuse_all(1).reshape(shape)
        whole = None
        if images := whole_pilots.result():
            by_a, by_b = (network.fuse_all(half, images).reshape(shape) for half in (0, 1))
            whole = np.float32(0.5) * (by_a + by_b)
    result = result_from_fused(
        evidence,
        fused,
        whole,
        settings,
        started,
        training.steps_done,
        training.history,
        training.notes,
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
    return replace(result, model=model)


class _TorchNetwork:
    """The network in torch; see `tungsten_dip.fit.training.Network`."""

    def __init__(self, weights: Weights, examples: Examples, device: torch.device) -> None:
        self._device = device
        self._pixels = examples.inputs.shape[1]
        # Both halves one after the other: one index for both is gathered far sooner than a pair.
        self._inputs, self._choices, self._wanted, self._weight = (
            torch.from_numpy(array).flatten(0, 1)
            for array in (examples.inputs, examples.choices, examples.wanted, examples.weight)
        )
        self._names = tuple(weights)
        self._parameters = [
            torch.from_numpy(value.reshape(value.shape[:2])).to(device, copy=True).requires_grad_()
            for value in weights.values()
        ]
        self._adam = _Adam(self._parameters)

    def step(self, half: Indices, pixel: Indices, learning_rate: float) -> None:
        """Do one step of Adam."""
        self._adam.step(self.gradients(half, pixel), learning_rate)

    def gradients(self, half: Indices, pixel: Indices) -> Sequence[Tensor]:
        """Return the gradients of the mean weighted squared error in the parameters."""
        at = torch.from_numpy(half * self._pixels + pixel)
        fused = self._fuse(at, self._gathered(self._choices, at))
        squared = (fused - self._gathered(self._wanted, at)) ** 2
        loss = (squared * self._gathered(self._weight, at)).mean()
        return torch.autograd.grad(loss, self._parameters)

    @torch.no_grad()
    def fuse(self, half: int, pixel: Indices | slice, images: Sequence[FloatImage] = ()) -> Array:
        """Return the weighted mean of the pilots or, by the same weights, of ``images``; (pixels, 3)."""
        within = np.arange(self._pixels)[pixel]
        at = torch.from_numpy(half * self._pixels + within)
        choices = self._gathered(self._choices, at)
        if images:
            parts = [image.reshape(-1, 3)[pixel] for image in images]
            choices = torch.from_numpy(np.stack(parts, axis=1)).to(self._device)
        fused: FloatImage = self._fuse(at, choices).cpu().numpy()
        return fused

    def fuse_all(self, half: int, images: Sequence[FloatImage] = ()) -> Array:
        """Return `fuse` of every pixel, not all at once."""
        firsts = range(0, self._pixels, _CHUNK_PIXELS)
        parts = [slice(first, first + _CHUNK_PIXELS) for first in firsts]
        return np.concatenate([self.fuse(half, part, images) for part in parts])

    def weights(self) -> Weights:
        """Return a copy of the weights, shaped as those of 1x1 convolutions."""
        copies = (value.detach().cpu().numpy().copy() for value in self._parameters)
        return {
            name: value[:, :, None, None] if value.ndim == 2 else value
            for name, value in zip(self._names, copies, strict=True)
        }

    @torch.no_grad()
    def load(self, weights: Weights) -> None:
        """Replace the weights."""
        for name, value in zip(self._names, self._parameters, strict=True):
            value.copy_(torch.from_numpy(weights[name].reshape(value.shape)))

    def _fuse(self, at: Tensor, choices: Tensor) -> Tensor:
        # Pixels last: a softmax over a short last axis crawls.
        x = self._gathered(self._inputs, at).t()
        layers = list(zip(self._parameters[::2], self._parameters[1::2], strict=True))
        for index, (weight, bias) in enumerate(layers):
            if index:
                x = nn.functional.leaky_relu(x, LEAKY_SLOPE)
            x = torch.addmm(bias[:, None], weight, x)
        return (x.softmax(0)[:, None] * choices.permute(1, 2, 0)).sum(0).t()

    def _gathered(self, values: Tensor, at: Tensor) -> Tensor:
        return values.index_select(0, at).to(self._device)


class _Adam:
    """Kingma and Ba 2015, "Adam". That of torch.optim takes longer to import than a draft takes to fit."""

    def __init__(self, parameters: list[Tensor]) -> None:
        self._parameters = parameters
        self._means = [torch.zeros_like(value) for value in parameters]
        self._squares = [torch.zeros_like(value) for value in parameters]
        self._steps = 0

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor], learning_rate: float) -> None:
        """Move the parameters against their gradients."""
        self._steps += 1
        keep, keep_square = ADAM_BETAS
        size = learning_rate / (1 - keep**self._steps)
        unbias = 1 / (1 - keep_square**self._steps)
        for value, gradient, mean, square in zip(
            self._parameters, gradients, self._means, self._squares, strict=True
        ):
            mean.lerp_(gradient, 1 - keep)
            square.mul_(keep_square).addcmul_(gradient, gradient, value=1 - keep_square)
            value.addcdiv_(mean, (square * unbias).sqrt_().add_(ADAM_EPSILON), value=-size)
