"""The presets draft, balanced and final: a small network chooses among pilots, trained across the halves.

The network sees one pixel of one half: its features, what the pilots of that half say, and how well each
pilot predicts the other half in the pixels around it (never in the pixel itself, whose noise it is scored by:
the blind spot of Krull et al. 2019, "Noise2Void"). It answers with the weights of a mean of the pilots, and
is trained to predict the other half, as in Lehtinen et al. 2018, "Noise2Noise". All this is linear in the
scored half, so noise adds a constant to the loss and nothing to the image: the mean is kept.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tungsten_dip import _core
from tungsten_dip.buffers.model import Buffer, FloatImage, RenderBuffers
from tungsten_dip.buffers.statistics import halves_independent
from tungsten_dip.fit.device import compute_device
from tungsten_dip.fit.fireflies import limit_fireflies
from tungsten_dip.fit.neighbours import mean_around
from tungsten_dip.fit.pilots import (
    BALANCED_PILOTS,
    DRAFT_PILOTS,
    FINAL_PILOTS,
    Guidance,
    Pilot,
    first_pilots,
    guidance_from_buffers,
    pilot_images,
)
from tungsten_dip.fit.settings import FitResult, FitSettings, HistoryPoint
from tungsten_dip.progress import Progress, silent

RELMSE_EPSILON = 0.01
_TYPICAL_RADIANCE = 0.25
"""Images are scaled so that their lit pixels have about this median: every constant below relies on it."""

_BRIGHTEST = 1e15
"""Brighter pixels, in these units, count as this bright: the squares of their differences overflow."""

_ONLY_PILOT = Pilot(9, k=1.0)
"""Used alone where nothing can score the pilots."""

_CONVERGED = 1e-5
"""relMSE of an image that nothing can improve: noise of 0.3% of the radiance."""

_LOG_OFFSET = 0.02
_SCORE_RADII = (2, 4, 8)
_NOISE_RADIUS = 8
_OUTLIER = 20.0
"""A squared error this many times the local mean is an outlier: capped where it tells of a place's noise."""

_LEAST_NOISE = 1.0
"""Relative variance of one half's pixel below which less noise does not make a pixel count more."""

_LEAST_SPREAD = 1e-6
_HIDDEN = 16
_BATCH_PIXELS = 1 << 14
_LEARNING_RATE = 1e-2
_WARM_UP_STEPS = 10
_HEAD_START = 1.0
"""Logit that the best single pilot starts with."""

_CHUNK_PIXELS = 1 << 18
_HISTORY_EVERY = 20
_HISTORY_PIXELS = 1 << 16
_ERROR_RADIUS = 4
_SURE = 0.35
"""Relative standard error of an estimated relMSE up to which it is believed."""


@dataclass(frozen=True)
class _Preset:
    pilots: tuple[Pilot, ...]
    steps: int


_PRESETS = {
    "draft": _Preset(DRAFT_PILOTS, 80),
    "balanced": _Preset(BALANCED_PILOTS, 240),
    "final": _Preset(FINAL_PILOTS, 600),
}


def fit_fusion(buffers: RenderBuffers, settings: FitSettings, progress: Progress = silent) -> FitResult:
    """Denoise sanitised buffers; see `tungsten_dip.fit.denoise`."""
    started = time.perf_counter()
    threads = settings.threads or 0
    notes: list[str] = []
    scale = _exposure(buffers.color.mean)

    def scaled(image: FloatImage) -> FloatImage:
        brightest = min(_BRIGHTEST / scale, float(np.finfo(np.float32).max))
        return np.minimum(image, np.float32(brightest)) * np.float32(scale)

    variance = None if buffers.color.variance is None else scaled(scaled(buffers.color.variance))

    missing = [name for name in ("albedo", "normal", "depth") if getattr(buffers, name) is None]
    if missing:
        notes.append(f"no {', '.join(missing)}: edges are found with less evidence")
    guidance = guidance_from_buffers(buffers, threads)
    progress(0.05, "features")

    color = buffers.color
    test = halves_independent(buffers, settings.threads)
    if color.half_a is None or color.half_b is None or not test.independent:
        if _converged(color):
            notes.append("the halves agree to within a few thousandths: the image is returned as it is")
            seconds = time.perf_counter() - started
            progress(1.0, "converged")
            return FitResult(color.mean.copy(), settings, seconds, iterations=0, notes=tuple(notes))
        notes.append(_why_no_halves(buffers, test))
        guides, irradiances, noise = first_pilots((scaled(color.mean),), variance, guidance)
        (image,) = pilot_images(_ONLY_PILOT, irradiances, guides, noise, guidance)
        seconds = time.perf_counter() - started
        progress(1.0, "one pilot")
        return FitResult(
            color=image / np.float32(scale), settings=settings, seconds=seconds, iterations=0,
            history=(HistoryPoint(seconds, 0, None),), notes=tuple(notes),
        )  # fmt: skip

    halves, fireflies = limit_fireflies(scaled(color.half_a), scaled(color.half_b), threads)
    if fireflies is not None:
        notes.append(fireflies)
    fit = _Fit(halves, guidance, settings, started)
    fit.add_pilots(variance, progress)
    # The network is too small to share: on a busy machine threads would only wait for one another.
    with compute_device(settings, most_threads=1) as device:
        notes += fit.train(device, progress)
        image, error, estimate = fit.result(device)

    # The error of the plain mean, by the same evidence.
    noisy = np.float32(0.5) * (halves[0] + halves[1])
    noise_of_input = (halves[0] - halves[1]) ** 2 / 4 / (image**2 + np.float32(RELMSE_EPSILON))
    noisy_estimate = float(noise_of_input.mean(dtype=np.float64))
    if estimate >= noisy_estimate:
        notes.append("the input is as good as anything fitted to it, and is returned as it is")
        image, estimate = scaled(color.mean) if fireflies is None else noisy, noisy_estimate
        error = _core.box_mean(noise_of_input.mean(axis=2, keepdims=True), _ERROR_RADIUS, threads)
    return FitResult(
        color=image / np.float32(scale),
        settings=settings,
        seconds=time.perf_counter() - started,
        iterations=fit.steps_done,
        error=error,
        estimated_relmse=estimate,
        history=tuple(fit.history),
        notes=tuple(notes),
    )


class _Fit:
    """The pilots of both halves, and the network that chooses among them."""

    def __init__(
        self, halves: tuple[FloatImage, FloatImage], guidance: Guidance, settings: FitSettings, started: float
    ) -> None:
        self.history: list[HistoryPoint] = []
        self.steps_done = 0
        self._halves = halves
        self._guidance = guidance
        self._settings = settings
        self._preset = _PRESETS[settings.preset]
        self._started = started
        # Per pilot, the images of both halves; the first is the noisy image itself.
        self._pilots: list[tuple[FloatImage, ...]] = [halves]

    def add_pilots(self, variance: FloatImage | None, progress: Progress) -> None:
        """Compute the pilots, as many as the time budget lets begin (one at least)."""
        guides, irradiances, noise = first_pilots(self._halves, variance, self._guidance)
        for index, pilot in enumerate(self._preset.pilots):
            progress(0.1 + 0.6 * index / len(self._preset.pilots), f"pilot {index + 1}")
            if index > 0 and self._seconds() > 0.7 * (self._settings.time_budget_s or math.inf):
                break
            self._pilots.append(pilot_images(pilot, irradiances, guides, noise, self._guidance))

    def train(self, device: torch.device, progress: Progress) -> list[str]:
        """Train the network; return notes. On Ctrl-C it goes on with what is learned."""
        settings = self._settings
        self._prepare()
        generator = torch.Generator().manual_seed(settings.seed)
        self._network = _network(self._inputs.shape[2], len(self._pilots), generator).to(device)
        optimizer = torch.optim.Adam(self._network.parameters(), lr=_LEARNING_RATE)
        steps = settings.iterations or self._preset.steps
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

    def result(self, device: torch.device) -> tuple[FloatImage, FloatImage, float]:
        """Return the image, its error per pixel and the mean of that (relMSE)."""
        shape = self._halves[0].shape
        fused_a, fused_b = (self._fuse_all(half, device) for half in (0, 1))
        unbiased, spread, estimate = _judged(fused_a, fused_b, self._witnesses(slice(None)))
        # Pixel by pixel the unbiased estimate is mostly noise. Its local mean tells where it is large, and
        # the halves' difference, which has little noise, is the least that it can be.
        threads = self._guidance.threads
        maps = [_core.box_mean(e.reshape(*shape[:2], 1), _ERROR_RADIUS, threads) for e in (unbiased, spread)]
        return (np.float32(0.5) * (fused_a + fused_b)).reshape(shape), np.maximum(*maps), estimate

    def _prepare(self) -> None:
        """Build what the network sees, flattened to shape (half, pixel, ...)."""
        threads = self._guidance.threads
        pixels = self._halves[0].shape[0] * self._halves[0].shape[1]
        count = len(self._pilots)
        self._choices = torch.empty(2, pixels, count, 3)
        for index, pilot in enumerate(self._pilots):
            for half in (0, 1):
                self._choices[half, :, index] = torch.from_numpy(pilot[half]).reshape(pixels, 3)
        self._other = torch.stack([torch.from_numpy(h).reshape(pixels, 3) for h in self._halves[::-1]])

        # Relative to what the half itself says, never to the half that scores it: a pixel must not count less
        # because the noise that it is compared with is bright, or the image would darken.
        smooth = self._pilots[-1]
        denominators = [
            image.mean(axis=2, keepdims=True) ** 2 + np.float32(RELMSE_EPSILON) for image in smooth
        ]
        errors = [
            [_error(*images) for images in zip(pilot, self._halves[::-1], denominators, strict=True)]
            for pilot in self._pilots
        ]
        mean_errors = [sum(float(np.minimum(e, 1).mean()) for e in pair) for pair in errors[1:]]
        self._best = 1 + int(np.argmin(mean_errors))

        noises = [
            mean_around(_capped(error, threads), _NOISE_RADIUS, threads) for error in errors[self._best]
        ]
        weights = [1 / (d * (_LEAST_NOISE + noise)) for d, noise in zip(denominators, noises, strict=True)]
        self._weight = torch.from_numpy(np.stack(weights)).reshape(2, pixels, 1)

        # Filled column by column: the inputs are the largest array of a fit.
        features = self._guidance.features
        columns = features.shape[2] + 2 + (count - 1) * (1 + len(_SCORE_RADII))
        inputs = np.empty((2, pixels, columns), np.float32)
        for half in (0, 1):
            noise, half_inputs = noises[half], iter(inputs[half].T)
            for channel in range(features.shape[2]):
                next(half_inputs)[:] = features[:, :, channel].ravel()
            next(half_inputs)[:] = np.log(noise + np.float32(1e-4)).ravel()
            base = _log_level(self._pilots[self._best][half])
            next(half_inputs)[:] = base.ravel()
            cap = np.float32(_OUTLIER) * noise + np.float32(1e-3)
            reference = np.minimum(errors[self._best][half], cap)
            for index in range(count):
                if index == self._best:
                    continue
                brighter = _log_level(self._pilots[index][half]) - base
                next(half_inputs)[:] = np.clip(brighter, -2, 2).ravel()
                worse = np.minimum(errors[index][half], cap) - reference
                for radius in _SCORE_RADII:
                    score = mean_around(worse, radius, threads) / (
                        np.float32(0.05) * noise + np.float32(1e-4)
                    )
                    next(half_inputs)[:] = np.clip(score, -3, 3).ravel()
        for column in range(columns):
            plane = inputs[:, :, column]
            plane -= plane.mean(dtype=np.float64)
            plane /= max(float(plane.std(dtype=np.float64)), _LEAST_SPREAD)
            np.clip(plane, -4, 4, out=plane)
        self._inputs = torch.from_numpy(inputs)

    def _fuse(self, half: Tensor | int, pixel: Tensor | slice, device: torch.device) -> Tensor:
        logits = self._network(self._inputs[half, pixel].to(device))
        logits[:, self._best] += _HEAD_START
        fused: Tensor = (logits.softmax(1)[..., None] * self._choices[half, pixel].to(device)).sum(1)
        return fused

    @torch.no_grad()
    def _fuse_all(self, half: int, device: torch.device) -> FloatImage:
        pixels = self._inputs.shape[1]
        parts = [
            self._fuse(half, slice(first, first + _CHUNK_PIXELS), device).cpu()
            for first in range(0, pixels, _CHUNK_PIXELS)
        ]
        return torch.cat(parts).numpy()

    @torch.no_grad()
    def _estimate_at(self, pixel: Tensor, device: torch.device) -> float:
        fused_a, fused_b = (self._fuse(half, pixel, device).cpu().numpy() for half in (0, 1))
        return _judged(fused_a, fused_b, self._witnesses(pixel))[2]

    def _witnesses(self, pixel: Tensor | slice) -> list[tuple[Array, Array]]:
        """The noisy halves and, far less noisy but a little blurred, the smallest pilot."""
        return [
            (self._choices[0, pixel, index].numpy(), self._choices[1, pixel, index].numpy())
            for index in (0, 1)
        ]

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


Array = npt.NDArray[np.float32]


def _judged(
    fused_a: Array, fused_b: Array, witnesses: list[tuple[Array, Array]]
) -> tuple[Array, Array, float]:
    """Estimate the squared error of f = (fused_a + fused_b) / 2, relative to f^2 + epsilon.

    Arrays have shape (pixels, 3). Returns, per pixel, the unbiased estimate and the part of it that is noise,
    and their mean over all pixels. With independent witnesses a, b of truth x and outputs f_a, f_b made of
    one half each, E (f_a - b)^2 is the error of f_a plus the noise of b, E (a - b)^2 the noise of both, and E
    (f_a - f_b)^2 / 2 the variance of one output; the mean of two has half of that. The first witnesses that
    leave the mean a small standard error are believed.
    """
    denominator = ((fused_a + fused_b) / 2) ** 2 + np.float32(RELMSE_EPSILON)
    noise = (((fused_a - fused_b) ** 2 / 4) / denominator).mean(axis=1)
    for half_a, half_b in witnesses:
        crossed = (fused_a - half_b) ** 2 + (fused_b - half_a) ** 2 - (half_a - half_b) ** 2
        unbiased = (crossed / 2 / denominator).mean(axis=1) - noise
        mean = float(unbiased.mean(dtype=np.float64))
        if float(unbiased.std(dtype=np.float64)) < _SURE * mean * math.sqrt(unbiased.size):
            break
    return unbiased, noise, max(mean, float(noise.mean(dtype=np.float64)))


def _error(image: FloatImage, other: FloatImage, denominator: FloatImage) -> FloatImage:
    error: FloatImage = ((image - other) ** 2).mean(axis=2, keepdims=True) / denominator
    return error


def _capped(error: FloatImage, threads: int) -> FloatImage:
    limit = np.float32(_OUTLIER) * _core.box_mean(error, _NOISE_RADIUS, threads)
    capped: FloatImage = np.minimum(error, limit)
    return capped


def _log_level(image: FloatImage) -> FloatImage:
    log_level: FloatImage = np.log(image.mean(axis=2, keepdims=True) + np.float32(_LOG_OFFSET))
    return log_level


def _converged(color: Buffer) -> bool:
    """Whether halves differ (copies do not) by less than lets a test tell if their noise is independent."""
    if color.half_a is None or color.half_b is None:
        return False
    squared = color.mean**2 + np.float32(RELMSE_EPSILON)
    noise = float(np.mean((color.half_a - color.half_b) ** 2 / 4 / squared))
    sampled = 0.0 if color.variance is None else float(np.mean(color.variance / squared))
    return 0 < noise < _CONVERGED and sampled < _CONVERGED


def _exposure(color: FloatImage) -> float:
    """The power of two that brings the median of the lit pixels near the typical radiance (exact to undo)."""
    level = color.mean(axis=2, dtype=np.float64)
    lit = level[level > 0]
    if lit.size == 0:
        return 1.0
    return float(2.0 ** np.clip(np.round(np.log2(_TYPICAL_RADIANCE / np.median(lit))), -100, 100))


def _why_no_halves(buffers: RenderBuffers, test: _core.HalvesTest) -> str:
    tail = "nothing can score the result: one pilot is used, without an estimate of its error"
    if not buffers.color.has_halves:
        return f"no half buffers: {tail}"
    return f"the half buffers are not independent (correlation {test.correlation:.2f}): {tail}"
