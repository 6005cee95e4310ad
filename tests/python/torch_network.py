"""The blend network in plain torch, as an oracle for the one that the fits train with onnxruntime."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from tungsten_dip.fit.model import Weights
from tungsten_dip.fit.network.blend_network import Examples

LEAKY_SLOPE = 0.2


class TorchNetwork:
    """Trained like `tungsten_dip.fit.network.blend_network.BlendNetwork`; gradients are autograd's."""

    def __init__(self, weights: Weights) -> None:
        self._parameters = {
            name: torch.tensor(value.reshape(value.shape[:2])).requires_grad_()
            for name, value in weights.items()
        }
        self._adam = torch.optim.Adam(self._parameters.values(), betas=(0.9, 0.999), eps=1e-8)

    def loss(self, batch: Examples) -> Tensor:
        target, weight = torch.from_numpy(batch.target), torch.from_numpy(batch.weight)
        error = ((self._blended(batch) - target) ** 2 * weight).mean(dim=1).sqrt()
        return 2 * nn.functional.huber_loss(error, torch.zeros_like(error), delta=30)

    def gradients(self, batch: Examples) -> tuple[Tensor, ...]:
        return torch.autograd.grad(self.loss(batch), list(self._parameters.values()))

    def step(self, batch: Examples, learning_rate: float) -> None:
        self._adam.param_groups[0]["lr"] = learning_rate
        self._adam.zero_grad()
        self.loss(batch).backward()
        self._adam.step()

    def blend(self, examples: Examples) -> np.ndarray:
        return self._blended(examples).detach().numpy()

    def weights(self) -> dict[str, np.ndarray]:
        return {name: value.detach().numpy() for name, value in self._parameters.items()}

    def _blended(self, examples: Examples) -> Tensor:
        x = torch.from_numpy(examples.inputs)
        for layer in (1, 2, 3):
            weight, bias = (self._parameters[f"layer{layer}.{name}"] for name in ("weight", "bias"))
            x = x @ weight.T + bias
            if layer < 3:
                x = nn.functional.leaky_relu(x, LEAKY_SLOPE)
        return (x.softmax(1)[:, :, None] * torch.from_numpy(examples.candidates)).sum(1)
