"""The pointwise network in plain torch, as an oracle for the one that the fits train with onnxruntime."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tungsten_dip.fit.model import Weights
from tungsten_dip.fit.pointwise import Examples

LEAKY_SLOPE = 0.2


class TorchNetwork:
    """The same interface as `tungsten_dip.fit.pointwise.PointwiseNetwork`; gradients are autograd's."""

    def __init__(self, weights: Weights, examples: Examples) -> None:
        self._examples = examples
        self._parameters = {
            name: torch.tensor(value.reshape(value.shape[:2])).requires_grad_()
            for name, value in weights.items()
        }
        self._adam = torch.optim.Adam(self._parameters.values(), betas=(0.9, 0.999), eps=1e-8)

    def loss(self, half: Any, pixel: Any) -> Tensor:
        wanted, weight = (
            torch.from_numpy(v[half, pixel]) for v in (self._examples.wanted, self._examples.weight)
        )
        return ((self._fused(half, pixel) - wanted) ** 2 * weight).mean()

    def gradients(self, half: Any, pixel: Any) -> tuple[Tensor, ...]:
        return torch.autograd.grad(self.loss(half, pixel), list(self._parameters.values()))

    def step(self, half: Any, pixel: Any, learning_rate: float) -> None:
        self._adam.param_groups[0]["lr"] = learning_rate
        self._adam.zero_grad()
        self.loss(half, pixel).backward()
        self._adam.step()

    def fuse(self, half: Any, pixel: Any) -> np.ndarray:
        return self._fused(half, pixel).detach().numpy()

    def weights(self) -> dict[str, np.ndarray]:
        return {name: value.detach().numpy() for name, value in self._parameters.items()}

    def _fused(self, half: Any, pixel: Any) -> Tensor:
        x = torch.from_numpy(self._examples.inputs[half, pixel])
        for layer in (1, 2, 3):
            weight, bias = (self._parameters[f"layer{layer}.{name}"] for name in ("weight", "bias"))
            x = x @ weight.T + bias
            if layer < 3:
                x = nn.functional.leaky_relu(x, LEAKY_SLOPE)
        choices = torch.from_numpy(self._examples.choices[half, pixel])
        return (x.softmax(1)[:, :, None] * choices).sum(1)
