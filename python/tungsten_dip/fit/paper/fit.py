"""The published method, to the letter where its code fixes it: the preset ``paper``.

Souri & Zakeri, "Deep Learning Based Denoiser for Images Rendered by Monte Carlo Sampling": a network is
fitted to one noisy LDR image by mean squared error, and the running average of its outputs is the denoised
image. ``docs/method.md`` states it whole, and where this differs from the published code and why.
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from tungsten_dip.buffers.display import radiance_from_ldr
from tungsten_dip.buffers.render_buffers import FloatImage, RenderBuffers
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.model import Model, Weights, check_finite, check_inputs, source_sha256
from tungsten_dip.fit.paper.constants import ITERATIONS
from tungsten_dip.fit.paper.device import compute_device, convolution_dtype, seeded_layers
from tungsten_dip.fit.paper.images import PaperImages, network_input, paper_images
from tungsten_dip.fit.paper.networks import ResNet, Skip
from tungsten_dip.fit.result import FitResult, HistoryPoint
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.progress import Progress

# The numbers of the published notebook.
LEARNING_RATE = 1e-3
LOW_LOSS = 5e-4
LOW_LOSS_LEARNING_RATE = 1e-4
INPUT_NOISE_STD = 1 / 30
AVERAGE_WEIGHT = 0.99
BACKTRACK_DB = 5.0

_HISTORY_EVERY = 100
_NOISE_WINDOWS = 1 << 16
_NOISE_STRIDE = 16


class PaperFit:
    """One fit in progress: every `step` is one iteration.

    ``loss`` is the mean squared error over all output channels, ``psnr`` that of the colour to the noisy
    colour in dB, both of the latest iteration's output.
    """

    def __init__(
        self,
        images: PaperImages,
        settings: FitSettings,
        device: torch.device,
        warm_start: Model | None = None,
    ) -> None:
        self.loss = math.inf
        self.psnr = -math.inf
        self._last_good_psnr = -math.inf
        generator = torch.Generator().manual_seed(settings.seed)

        # Rounding to bfloat16 is far below the noise that every iteration adds to the input. Sums stay in
        # float32, and so do weights. Within a caller's autocast its cache would outlive an iteration and keep
        # the weights of the first.
        dtype = convolution_dtype(device)
        self._precision = torch.autocast(
            device.type, dtype, enabled=dtype != torch.float32, cache_enabled=False
        )
        fixed = torch.from_numpy(network_input(images, settings.seed))
        channels = fixed.shape[2]
        self._input = _nchw(fixed.to(device, dtype))
        self._noisy_input = torch.empty_like(self._input)
        # Drawing every value anew would cost more than the network's first layer. The noise of an iteration
        # is a window of this pool at a place drawn anew, so that a pixel gets the same value twice only by
        # chance.
        pool_size = fixed.numel() + _NOISE_WINDOWS * _NOISE_STRIDE
        pool = torch.randn(pool_size, generator=generator, dtype=torch.float32, device="cpu")
        self._noise_pool = pool.to(device, dtype)
        self._generator = generator

        self._wanted = _nchw(torch.from_numpy(images.wanted).to(device))
        self._average: Tensor | None = None
        with seeded_layers(settings.seed):
            outputs = images.wanted.shape[2]
            self.network: nn.Module = (
                Skip(channels, outputs, settings.channels)
                if settings.network == "skip"
                else ResNet(channels, outputs)
            )
        if warm_start is not None:
            state = {name: torch.from_numpy(weight) for name, weight in warm_start.weights.items()}
            self.network.load_state_dict(state)
        self.network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._weights = _as_one_vector(self.network)
        self._good_weights = self._weights.clone()
        self._optimizer = torch.optim.Adam([self._weights], lr=LEARNING_RATE, fused=True)

    def step(self) -> None:
        """Do one iteration."""
        place = torch.randint(_NOISE_WINDOWS, (), generator=self._generator, device="cpu")
        window = _NOISE_STRIDE * int(place)
        noise = self._noise_pool[window : window + self._input.numel()]
        noise = noise.view(self._input.permute(0, 2, 3, 1).shape).permute(0, 3, 1, 2)
        torch.add(self._input, noise, alpha=INPUT_NOISE_STD, out=self._noisy_input)

        with self._precision:
            output = self.network(self._noisy_input).float()
        loss = F.mse_loss(output, self._wanted)
        detached = output.detach()
        self.loss = loss.item()
        color_loss = (
            self.loss if detached.shape[1] == 3 else F.mse_loss(detached[:, :3], self._wanted[:, :3]).item()
        )
        self.psnr = -10 * math.log10(max(color_loss, 1e-12))
        if not self.psnr >= self._last_good_psnr - BACKTRACK_DB:
            self._weights.copy_(self._good_weights)
            return
        self._good_weights.copy_(self._weights)
        self._last_good_psnr = self.psnr
        if self._average is None:
            self._average = detached.clone()
        else:
            self._average.lerp_(detached, 1 - AVERAGE_WEIGHT)

        self._optimizer.zero_grad(set_to_none=False)
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.param_groups[0]["lr"] = learning_rate(self.loss)
        self._optimizer.step()

    def weights(self) -> Weights:
        """Return a copy of the network's weights by name."""
        state = self.network.state_dict()
        return {name: weight.contiguous().cpu().numpy().copy() for name, weight in state.items()}

    def color(self) -> FloatImage:
        """Return the average so far as linear radiance, shape (height, width, 3)."""
        if self._average is None:
            raise RuntimeError("no iteration has been done yet")
        ldr = self._average[0, :3].permute(1, 2, 0).cpu().numpy()
        return np.ascontiguousarray(radiance_from_ldr(ldr))


def learning_rate(loss: float) -> float:
    """Adam's learning rate at this loss."""
    return LOW_LOSS_LEARNING_RATE if loss <= LOW_LOSS else LEARNING_RATE


def fit_paper(
    buffers: RenderBuffers,
    settings: FitSettings,
    progress: Progress,
    warm_start: Model | None,
) -> FitResult:
    """Denoise sanitised buffers by the published method, from the weights of a model if there is one.

    Ends after ``settings.iterations`` or ``settings.time_budget_s``, whichever comes first, but not before
    the first iteration. An interrupt (KeyboardInterrupt) after it ends the fit with the average so far. On a
    CPU, the same seed and number of threads give the same bits.

    Raises InputError if a feature named by the inputs is missing, the device is not there, or the model does
    not fit the image or the settings or gives no finite image.
    """
    clock = Clock(settings.time_budget_s)
    images = paper_images(buffers, settings)
    if warm_start is not None:
        check_inputs(warm_start, images.inputs)
    total = settings.iterations or ITERATIONS
    notes = [*_notes_on_method(buffers, settings), *images.notes]
    history = []
    iteration, interrupted = 0, False
    with compute_device(settings) as device:
        fit = PaperFit(images, settings, device, warm_start)
        try:
            while iteration < total:
                fit.step()
                if iteration == 0:
                    check_finite(np.asarray(fit.loss, np.float32))  # later steps go back to good weights
                iteration += 1
                spent = clock.share_spent()
                done = iteration == total or spent >= 1
                if done or iteration % _HISTORY_EVERY == 0:
                    history.append(HistoryPoint(clock.seconds(), iteration, None))
                progress(
                    min(max(iteration / total, spent), 1.0),
                    f"iteration {iteration}, loss {fit.loss:.2e}, PSNR to noisy {fit.psnr:.2f} dB",
                )
                if done:
                    break
        except KeyboardInterrupt:
            if iteration == 0:
                raise
            interrupted = True
            notes.append(f"interrupted at iteration {iteration} of {total}")
        else:
            if iteration < total:
                notes.append(f"the time budget ended at iteration {iteration} of {total}")
        color, weights = fit.color(), fit.weights()
    model = Model(images.inputs, weights, settings, None, source_sha256(buffers))
    return FitResult(
        color,
        settings,
        clock.seconds(),
        iteration,
        model=model,
        history=tuple(history),
        interrupted=interrupted,
        notes=tuple(notes),
    )


def _notes_on_method(buffers: RenderBuffers, settings: FitSettings) -> list[str]:
    notes = [
        "no error estimate: the published method fits the mean of all samples, no independent half is left"
    ]
    clipped = float((buffers.color.mean > 1).any(axis=2).mean())
    if clipped:
        notes.append(f"{clipped:.2%} of the pixels exceed 1: the published method clips highlights")
    if settings.pilot != "none":
        notes.append("pilot is not used: the published method fits the colour alone")
    if settings.target_error is not None:
        notes.append("target_error is not used: the published method cannot estimate its error")
    if settings.scheme == "ioc":
        notes.append("scheme ioc: the input is random, and inputs is not used")
    return notes


def _as_one_vector(network: nn.Module) -> Tensor:
    """Make all weights views of one vector, which is returned, and their gradients views of its gradient.

    Steps, copies and zeros are then one loop each in place of one for every weight. Weights of convolutions
    keep their channels last in memory.
    """
    weights = list(network.parameters())
    vector = torch.empty(
        sum(weight.numel() for weight in weights), device=weights[0].device, dtype=weights[0].dtype
    )
    vector.grad = torch.zeros_like(vector)
    first = 0
    for weight in weights:
        part = slice(first, first + weight.numel())
        view, gradient = (
            whole[part].view(weight.movedim(1, -1).shape).movedim(-1, 1)
            if weight.dim() == 4
            else whole[part].view(weight.shape)
            for whole in (vector, vector.grad)
        )
        weight.data, weight.grad = view.copy_(weight.data), gradient
        first = part.stop
    return vector


def _nchw(image: Tensor) -> Tensor:
    """(height, width, channels) as a batch of one, channels last in memory."""
    return image.contiguous()[None].permute(0, 3, 1, 2)
