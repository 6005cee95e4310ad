"""The presets draft, balanced and final: a small network chooses among pilots, trained across the halves.

The network sees one pixel of one half: its planes (`evidence`). It answers with the weights of a mean of the
pilots, and is trained to predict the other half, as in Lehtinen et al. 2018, "Noise2Noise". All this is
linear in the scored half, so noise adds a constant to the loss and nothing to the image: the mean is kept.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

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
    asked = pilots if warm_start is None or warm_start.layout is None else warm_start.layout
    evidence = evidence_from_buffers(buffers, settings, asked, candidates, started, progress, previous)
    if isinstance(evidence, FitResult):
        return evidence
    start = start_of_training(evidence, settings.seed, warm_start)
    # The network is too small to share: on a busy machine threads would only wait for one another.
    with compute_device(settings, most_threads=1) as device:
        network = _TorchNetwork(start.weights, start.examples, device)
        steps = settings.iterations or preset.steps
        training = train(network, start, settings, steps, started, progress)
        fused = network.fuse_all(0), network.fuse_all(1)
    shape = evidence.mean.shape
    result = result_from_fused(
        start.evidence,
        (fused[0].reshape(shape), fused[1].reshape(shape)),
        settings,
        started,
        training.steps_done,
        training.history,
        training.notes,
    )
    model = Model(
        kind="pointwise",
        planes=start.evidence.layout.planes,
        weights=network.weights(),
        settings=settings,
        estimated_relmse=result.estimated_relmse,
        source_sha256=source_sha256(buffers),
        layout=start.evidence.layout,
        standardisation=start.standardisation,
    )
    return replace(result, model=model)


class _TorchNetwork:
    """The network in torch; see `tungsten_dip.fit.training.Network`."""

    def __init__(self, weights: Weights, examples: Examples, device: torch.device) -> None:
        self._device = device
        self._inputs, self._choices, self._wanted, self._weight = (
            torch.from_numpy(array)
            for array in (examples.inputs, examples.choices, examples.wanted, examples.weight)
        )
        layers: list[nn.Module] = []
        for layer in (1, 2, 3):
            outputs, inputs = weights[f"layer{layer}.weight"].shape[:2]
            layers += [nn.Linear(inputs, outputs), nn.LeakyReLU(LEAKY_SLOPE)]
        self._network = nn.Sequential(*layers[:-1]).to(device)
        self._parameters = dict(zip(weights, self._network.parameters(), strict=True))
        self.load(weights)
        self._optimizer = torch.optim.Adam(
            self._network.parameters(), lr=0.0, betas=ADAM_BETAS, eps=ADAM_EPSILON
        )

    def step(self, half: Indices, pixel: Indices, learning_rate: float) -> None:
        """Do one step of Adam."""
        self._optimizer.param_groups[0]["lr"] = learning_rate
        at = torch.from_numpy(half), torch.from_numpy(pixel)
        squared = (self._fuse(*at) - self._wanted[at].to(self._device)) ** 2
        loss = (squared * self._weight[at].to(self._device)).mean()
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()

    @torch.no_grad()
    def fuse(self, half: int, pixel: Indices | slice) -> Array:
        """Return the weighted mean of the pilots, shape (pixels, 3)."""
        at = pixel if isinstance(pixel, slice) else torch.from_numpy(pixel)
        fused: FloatImage = self._fuse(half, at).cpu().numpy()
        return fused

    def fuse_all(self, half: int) -> Array:
        """Return `fuse` of every pixel, not all at once."""
        pixels = range(0, self._inputs.shape[1], _CHUNK_PIXELS)
        return np.concatenate([self.fuse(half, slice(first, first + _CHUNK_PIXELS)) for first in pixels])

    @torch.no_grad()
    def weights(self) -> Weights:
        """Return a copy of the weights, shaped as those of 1x1 convolutions."""
        copies = {name: value.cpu().numpy().copy() for name, value in self._parameters.items()}
        return {name: w[:, :, None, None] if w.ndim == 2 else w for name, w in copies.items()}

    @torch.no_grad()
    def load(self, weights: Weights) -> None:
        """Replace the weights."""
        for name, value in self._parameters.items():
            value.copy_(torch.from_numpy(weights[name].reshape(value.shape)))

    def _fuse(self, half: Tensor | int, pixel: Tensor | slice) -> Tensor:
        logits = self._network(self._inputs[half, pixel].to(self._device))
        fused: Tensor = (logits.softmax(1)[..., None] * self._choices[half, pixel].to(self._device)).sum(1)
        return fused
