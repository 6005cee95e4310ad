"""The published network in plain PyTorch, as its description reads: what ours is timed against.

Written from the description of the network (five scales, 3x3 convolutions with mirrored edges, stride 2 down,
bilinear up, batch norm, LeakyReLU 0.2). It is not the published code, but has as many parameters.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from tungsten_dip.fit.paper.constants import LEAKY_SLOPE
from tungsten_dip.fit.paper.fit import (
    AVERAGE_WEIGHT,
    BACKTRACK_DB,
    INPUT_NOISE_STD,
    LEARNING_RATE,
    learning_rate,
)

_SKIP_CHANNELS = (0, 0, 0, 4, 4)
"""Channels of the skip connection at each scale, from the finest on."""


class PlainSkip(nn.Module):
    """Maps (1, in_channels, height, width), both multiples of 32, to (1, 3, height, width) in [0, 1]."""

    def __init__(self, in_channels: int, channels: tuple[int, ...] = (8, 16, 32, 64, 128)) -> None:
        super().__init__()
        self.down, self.side, self.up = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        for index, (count, across) in enumerate(zip(channels, _SKIP_CHANNELS, strict=True)):
            source = channels[index - 1] if index else in_channels
            deeper = channels[min(index + 1, len(channels) - 1)]
            self.side.append(_block(source, across, 1) if across else nn.Identity())
            self.down.append(nn.Sequential(_block(source, count, 3, stride=2), _block(count, count, 3)))
            norm = nn.BatchNorm2d(across + deeper)
            self.up.append(nn.Sequential(norm, _block(across + deeper, count, 3), _block(count, count, 1)))
        self.head = nn.Conv2d(channels[0], 3, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Return the network's output for an input."""
        sides = []
        x = image
        for down, side in zip(self.down, self.side, strict=True):
            sides.append(None if isinstance(side, nn.Identity) else side(x))
            x = down(x)
        for up, across in zip(reversed(self.up), reversed(sides), strict=True):
            x = F.interpolate(x, scale_factor=2, mode="bilinear")
            x = up(x if across is None else torch.cat((across, x), 1))
        return torch.sigmoid(self.head(x))


def _block(in_channels: int, out_channels: int, size: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, size, stride, padding=size // 2, padding_mode="reflect"),
        nn.BatchNorm2d(out_channels),
        nn.LeakyReLU(LEAKY_SLOPE),
    )


class PlainFit:
    """The published method's iteration around it: fresh noise, average, backtracking, Adam."""

    def __init__(self, network: nn.Module, fixed_input: Tensor, wanted: Tensor) -> None:
        self.network = network
        self._input, self._wanted = fixed_input, wanted
        self._average: Tensor | None = None
        self._last_psnr = -math.inf
        self._good = [weight.detach().clone() for weight in network.parameters()]
        self._optimizer = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE)

    def step(self) -> None:
        """Do one iteration."""
        output = self.network(self._input + torch.randn_like(self._input) * INPUT_NOISE_STD)
        loss = F.mse_loss(output, self._wanted)
        seen = output.detach()
        before = seen if self._average is None else self._average
        self._average = before * AVERAGE_WEIGHT + seen * (1 - AVERAGE_WEIGHT)
        psnr = -10 * math.log10(max(loss.item(), 1e-12))
        if psnr < self._last_psnr - BACKTRACK_DB:
            with torch.no_grad():
                for weight, good in zip(self.network.parameters(), self._good, strict=True):
                    weight.copy_(good)
            return
        self._good = [weight.detach().clone() for weight in self.network.parameters()]
        self._last_psnr = psnr
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.param_groups[0]["lr"] = learning_rate(loss.item())
        self._optimizer.step()
