"""Seconds per iteration of the published method: ours, plain PyTorch, and only the convolutions."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from tungsten_dip.bench.machine import machine_facts
from tungsten_dip.bench.plain_skip import PlainFit, PlainSkip
from tungsten_dip.bench.sets import CROP_MULTIPLE
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.errors import InputError, whole_number
from tungsten_dip.fit.paper.device import compute_device
from tungsten_dip.fit.paper.fit import PaperFit
from tungsten_dip.fit.paper.images import paper_images
from tungsten_dip.fit.settings import MOST_ITERATIONS, FitSettings
from tungsten_dip.progress import Progress, silent

WARM_UP = 3
"""Iterations that are not counted."""


@dataclass(frozen=True)
class IterationTimes:
    """Median seconds of one iteration, in turns on one machine.

    ``convolutions_s`` is the time of only the plain network's convolutions, forwards and backwards, each in
    the faster of two memory layouts. ``flops`` are theirs, of one iteration, a multiplication and an addition
    being two. ``peak_flops_per_s`` is what the best of them reaches.
    """

    ours_s: float
    plain_s: float
    convolutions_s: float
    flops: float
    peak_flops_per_s: float

    @property
    def speedup(self) -> float:
        """How many times as fast ours is as plain PyTorch."""
        return self.plain_s / self.ours_s


def time_iterations(
    width: int,
    height: int,
    *,
    iterations: int,
    repeats: int,
    threads: int | None,
    progress: Progress = silent,
) -> IterationTimes:
    """Time the network Skip with all inputs and the random one on an image of noise.

    Every repeat runs ``iterations`` of each in turn.

    Raises InputError if a side is no multiple of 32 (the published method crops to one) or below 64 (its
    coarsest scale would be one pixel, which cannot be normalised), or a number is below 1.
    """
    if min(width, height) < 2 * CROP_MULTIPLE or width % CROP_MULTIPLE or height % CROP_MULTIPLE:
        raise InputError(
            f"size: expected multiples of {CROP_MULTIPLE} from {2 * CROP_MULTIPLE} on such as 512x288, "
            f"got {width}x{height}"
        )
    iterations = whole_number("iterations", iterations, 1, MOST_ITERATIONS)
    repeats = whole_number("repeats", repeats, 1, MOST_ITERATIONS)
    settings = FitSettings("paper", threads=threads, device="cpu")
    images = paper_images(_noise(width, height), settings)
    with compute_device(settings) as device:
        ours = PaperFit(images, settings, device)
        given = torch.from_numpy(images.given).permute(2, 0, 1)[None]
        random = torch.rand(1, images.random_channels, height, width)
        wanted = torch.from_numpy(images.wanted).permute(2, 0, 1)[None].contiguous()
        torch.manual_seed(0)
        network = PlainSkip(images.random_channels + given.shape[1])
        fixed_input = torch.cat((random, given), 1).contiguous()
        plain = PlainFit(network, fixed_input, wanted)
        layers = _convolutions(network, fixed_input)

        for _ in range(WARM_UP):
            ours.step()
            plain.step()
        ours_s, plain_s = [], []
        alone_s: list[list[float]] = [[] for _ in layers]
        for repeat in range(repeats):
            ours_s.append(_seconds(ours.step, iterations))
            plain_s.append(_seconds(plain.step, iterations))
            for layer, seconds in zip(layers, alone_s, strict=True):
                seconds.append(min(_seconds(run, iterations) for run in layer.runs))
            progress((repeat + 1) / repeats, f"ours {ours_s[-1]:.4f} s, plain {plain_s[-1]:.4f} s")
    medians = [statistics.median(seconds) for seconds in alone_s]
    return IterationTimes(
        statistics.median(ours_s),
        statistics.median(plain_s),
        sum(medians),
        sum(layer.flops for layer in layers),
        max(layer.flops / seconds for layer, seconds in zip(layers, medians, strict=True)),
    )


def times_text(times: IterationTimes, width: int, height: int, threads: int | None) -> str:
    """Return the times as a table in Markdown."""
    flops_per_s = times.flops / times.ours_s
    rows = (
        ("ours", times.ours_s),
        ("plain PyTorch", times.plain_s),
        ("only its convolutions", times.convolutions_s),
    )
    lines = [f"| {name} | {seconds * 1e3:.1f} | {times.ours_s / seconds:.2f} |" for name, seconds in rows]
    return "\n".join(
        [
            f"Skip, all+random, {width} x {height}. Plain PyTorch is written from the method's description, "
            "it is not the published code.",
            "",
            "| | ms per iteration | ours over it |",
            "|---|--:|--:|",
            *lines,
            "",
            f"Ours is {times.speedup:.2f} times as fast as plain PyTorch and does the convolutions' "
            f"{times.flops / 1e9:.2f} GFLOP at {flops_per_s / 1e9:.1f} GFLOP/s, "
            f"{flops_per_s / times.peak_flops_per_s:.0%} of the {times.peak_flops_per_s / 1e9:.1f} GFLOP/s "
            "that the fastest of these shapes reaches by itself.",
            "",
            "Measured with: " + "; ".join(f"{name} {value}" for name, value in machine_facts(threads)) + ".",
        ]
    )


@dataclass(frozen=True)
class _Convolution:
    """One layer's work, forwards and backwards; ``runs`` do it in different memory layouts."""

    flops: float
    runs: tuple[Callable[[], None], ...]


def _convolutions(network: nn.Module, image: Tensor) -> list[_Convolution]:
    """Return the work of every convolution of the network on an image."""
    shapes: list[tuple[nn.Conv2d, torch.Size]] = []

    def note(layer: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        assert isinstance(layer, nn.Conv2d)
        shapes.append((layer, inputs[0].shape))

    hooks = [layer.register_forward_hook(note) for layer in network.modules() if isinstance(layer, nn.Conv2d)]
    with torch.no_grad():
        network(image)
    for hook in hooks:
        hook.remove()
    found = []
    for layer, shape in shapes:
        border = layer.kernel_size[0] // 2
        padded = torch.rand(shape[0], shape[1], shape[2] + 2 * border, shape[3] + 2 * border)
        weight = layer.weight.detach()
        first = shape[1] == image.shape[1] and shape[2] == image.shape[2]
        output_pixels = (shape[2] // layer.stride[0]) * (shape[3] // layer.stride[1])
        # Forwards, the gradient of the weights and, except where the image is the input, that of the input.
        passes = 2 if first else 3
        runs = tuple(
            _run(padded.to(memory_format=layout), weight.to(memory_format=layout), layer.stride[0], not first)
            for layout in (torch.contiguous_format, torch.channels_last)
        )
        found.append(_Convolution(passes * 2.0 * weight.numel() * output_pixels, runs))
    return found


def _run(image: Tensor, weight: Tensor, stride: int, differentiate_image: bool) -> Callable[[], None]:
    image = image.requires_grad_(differentiate_image)
    weight = weight.requires_grad_()
    gradient = torch.ones_like(F.conv2d(image, weight, stride=stride))

    def run() -> None:
        weight.grad = image.grad = None
        F.conv2d(image, weight, stride=stride).backward(gradient)  # type: ignore[no-untyped-call]

    return run


def _seconds(run: Callable[[], None], iterations: int) -> float:
    start = time.perf_counter()
    for _ in range(iterations):
        run()
    return (time.perf_counter() - start) / iterations


def _noise(width: int, height: int) -> RenderBuffers:
    rng = np.random.default_rng(0)

    def buffer(channels: int) -> Buffer:
        return Buffer(*(rng.random((height, width, channels), dtype=np.float32) for _ in range(4)))

    return RenderBuffers(buffer(3), albedo=buffer(3), normal=buffer(3), depth=buffer(1))
