"""The presets draft, balanced and final: a small network chooses among pilots, trained across the halves.

The network sees one pixel of one half: its planes (`evidence`). It answers with the weights of a mean of the
pilots, and is trained to predict the other half, as in Lehtinen et al. 2018, "Noise2Noise". All this is
linear in the scored half, so noise adds a constant to the loss and nothing to the image: the mean is kept.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from tungsten_dip.buffers.model import FloatImage, RenderBuffers
from tungsten_dip.fit.device import compute_device
from tungsten_dip.fit.evidence import (
    Evidence,
    Halves,
    estimate_error,
    evidence_from_buffers,
    loss_weights,
    network_inputs,
    result_from_fused,
    standardisation_of,
    witnesses,
)
from tungsten_dip.fit.pilots import BALANCED_PILOTS, DRAFT_PILOTS, FINAL_PILOTS, Pilot
from tungsten_dip.fit.settings import FitResult, FitSettings, HistoryPoint
from tungsten_dip.progress import Progress, silent

_HIDDEN = 16
_BATCH_PIXELS = 1 << 14
_LEARNING_RATE = 1e-2
_WARM_UP_STEPS = 10
_HEAD_START = 1.0
"""Logit that the best single pilot starts with."""

_CHUNK_PIXELS = 1 << 18
_HISTORY_EVERY = 20
_HISTORY_PIXELS = 1 << 16


@dataclass(frozen=True)
class _Preset:
    pilots: tuple[Pilot, ...]
    steps: int


_PRESETS = {
    "draft": _Preset(DRAFT_PILOTS, 80),
    "balanced": _Preset(BALANCED_PILOTS, 240),
    "final": _Preset(FINAL_PILOTS, 600),
}


def fit_fusion(
    buffers: RenderBuffers,
    settings: FitSettings,
    progress: Progress = silent,
    candidates: Sequence[Halves] = (),
) -> FitResult:
    """Denoise sanitised buffers; see `tungsten_dip.fit.denoise`."""
    started = time.perf_counter()
    preset = _PRESETS[settings.preset]
    evidence = evidence_from_buffers(buffers, settings, preset.pilots, candidates, started, progress)
    if isinstance(evidence, FitResult):
        return evidence
    fit = _Fit(evidence, settings, started)
    # The network is too small to share: on a busy machine threads would only wait for one another.
    with compute_device(settings, most_threads=1) as device:
        notes = fit.train(device, progress)
        fused = fit.fuse_all(0, device), fit.fuse_all(1, device)
    return result_from_fused(evidence, fused, settings, started, fit.steps_done, fit.history, notes)


class _Fit:
    """The network that chooses among the pilots of both halves."""

    def __init__(self, evidence: Evidence, settings: FitSettings, started: float) -> None:
        self.history: list[HistoryPoint] = []
        self.steps_done = 0
        self._settings = settings
        self._started = started
        self._shape = evidence.halves[0].shape
        self._reference = evidence.reference
        self._witnesses = witnesses(evidence)
        inputs = network_inputs(evidence)
        standardisation_of(inputs).apply(inputs)
        self._inputs = torch.from_numpy(inputs)
        # All with shape (half, pixel, ...).
        pixels = inputs.shape[1]
        self._choices = torch.empty(2, pixels, len(evidence.pilots), 3)
        for index, pilot in enumerate(evidence.pilots):
            for half in (0, 1):
                self._choices[half, :, index] = torch.from_numpy(pilot[half]).reshape(pixels, 3)
        self._other = torch.stack([torch.from_numpy(h).reshape(pixels, 3) for h in evidence.halves[::-1]])
        self._weight = torch.stack([torch.from_numpy(w).reshape(pixels, 1) for w in loss_weights(evidence)])

    def train(self, device: torch.device, progress: Progress) -> list[str]:
        """Train the network; return notes. On Ctrl-C it goes on with what is learned."""
        settings = self._settings
        generator = torch.Generator().manual_seed(settings.seed)
        self._network = _network(self._inputs.shape[2], self._choices.shape[2], generator).to(device)
        optimizer = torch.optim.Adam(self._network.parameters(), lr=_LEARNING_RATE)
        steps = settings.iterations or _PRESETS[settings.preset].steps
        pixels = self._inputs.shape[1]
        probe = torch.randperm(pixels, generator=generator)[:_HISTORY_PIXELS]
        notes: list[str] = []
        try:
            for step in range(steps):
                rate = min(1.0, (step + 1) / _WARM_UP_STEPS) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
                for group in optimizer.param_groups:
                    group["lr"] = _LEARNING_RATE * rate
                batch = torch.randint(2 * pixels, (min(_BATCH_PIXELS, 2 * pixels),), generator=generator)
                half, pixel = batch // pixels, batch % pixels
                fused = self._fuse(half, pixel, device)
                squared = (fused - self._other[half, pixel].to(device)) ** 2
                loss = (squared * self._weight[half, pixel].to(device)).mean()
                optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                optimizer.step()
                self.steps_done = step + 1
                if step % _HISTORY_EVERY == 0 or step == steps - 1:
                    estimate = self._estimate_at(probe, device)
                    self.history.append(HistoryPoint(self._seconds(), step + 1, estimate))
                    progress(0.75 + 0.25 * (step + 1) / steps, f"relMSE {estimate:.4g}")
                    if estimate <= (settings.target_error or -math.inf):
                        notes.append(f"stopped at step {step + 1}: the target error is reached")
                        break
                    if self._seconds() > (settings.time_budget_s or math.inf):
                        notes.append(f"stopped at step {step + 1}: the time budget is spent")
                        break
        except KeyboardInterrupt:
            notes.append(f"interrupted at step {self.steps_done}: the image is what was reached by then")
        return notes

    @torch.no_grad()
    def fuse_all(self, half: int, device: torch.device) -> FloatImage:
        """Return what the network makes of one half, shape (height, width, 3)."""
        pixels = self._inputs.shape[1]
        parts = [
            self._fuse(half, slice(first, first + _CHUNK_PIXELS), device).cpu()
            for first in range(0, pixels, _CHUNK_PIXELS)
        ]
        image: FloatImage = torch.cat(parts).numpy().reshape(self._shape)
        return image

    def _fuse(self, half: Tensor | int, pixel: Tensor | slice, device: torch.device) -> Tensor:
        logits = self._network(self._inputs[half, pixel].to(device))
        logits[:, self._reference] += _HEAD_START
        fused: Tensor = (logits.softmax(1)[..., None] * self._choices[half, pixel].to(device)).sum(1)
        return fused

    @torch.no_grad()
    def _estimate_at(self, pixel: Tensor, device: torch.device) -> float:
        fused_a, fused_b = (self._fuse(half, pixel, device).cpu().numpy() for half in (0, 1))
        at = pixel.numpy()
        return estimate_error(fused_a, fused_b, [(a[at], b[at]) for a, b in self._witnesses])[2]

    def _seconds(self) -> float:
        return time.perf_counter() - self._started


def _network(inputs: int, outputs: int, generator: torch.Generator) -> nn.Sequential:
    network = nn.Sequential(
        nn.Linear(inputs, _HIDDEN),
        nn.LeakyReLU(0.2),
        nn.Linear(_HIDDEN, _HIDDEN),
        nn.LeakyReLU(0.2),
        nn.Linear(_HIDDEN, outputs),
    )
    for parameter in network.parameters():
        if parameter.ndim == 2:
            nn.init.kaiming_uniform_(parameter, a=0.2, generator=generator)
        else:
            nn.init.zeros_(parameter)
    # Starts from the mean of the pilots that the head start gives, whatever the seed.
    nn.init.zeros_(network[-1].weight)  # type: ignore[arg-type]
    return network
