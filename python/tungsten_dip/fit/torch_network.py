"""The network that chooses among pilots, in torch, and its optimiser."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from tungsten_dip.buffers.model import FloatImage
from tungsten_dip.fit.evidence import Array, Indices
from tungsten_dip.fit.model import Weights
from tungsten_dip.fit.training import ADAM_BETAS, ADAM_EPSILON, LEAKY_SLOPE, Examples

_CHUNK_PIXELS = 1 << 18


class TorchNetwork:
    """See `tungsten_dip.fit.training.Network`, for its methods as well."""

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
