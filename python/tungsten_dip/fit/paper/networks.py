"""The two networks of the published method: Skip (Ulyanov et al., "Deep Image Prior", CVPR 2018) and ResNet.

No other preset uses them. They are the baseline that the other presets are compared with, also by time, and
so must not be slower than need be. Hence layers of our own where those of PyTorch are slow ("Seconds per
iteration" in docs/method.md has what they bring).

Both take (batch, channels, height, width) of any size from 1x1 and return the same size. A batch norm always
uses the statistics of the batch in hand, in ``eval()`` too: on one image it is an instance norm.

On a CPU both are fastest with channels last in memory (``network.to(memory_format=torch.channels_last)``, and
the input alike).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from tungsten_dip import _core
from tungsten_dip.fit.paper.constants import (
    LEAKY_SLOPE,
    NORM_EPSILON,
    RESNET_BLOCKS,
    RESNET_WIDTH,
    SIDE_CHANNELS,
    SIDE_SCALES,
)

Pointwise = Callable[[Tensor], Tensor]
"""A function that treats every pixel alike and by itself."""

_FEW_THREADS = 4
"""Up to here the core, on one thread, is taken to be faster than PyTorch on all; measured with 1 and 2."""


class Skip(nn.Module):
    """Encoder and decoder with connections across at the coarse scales.

    ``channels`` are the counts from the finest scale to the coarsest, down and up alike. The input is
    mirrored up to a multiple of 2**scales and the output cropped back.
    """

    def __init__(
        self, in_channels: int, out_channels: int = 3, channels: tuple[int, ...] = (8, 16, 32, 64, 128)
    ) -> None:
        super().__init__()
        scales = len(channels)
        across = tuple(SIDE_CHANNELS if scale >= scales - SIDE_SCALES else 0 for scale in range(scales))
        sources = (in_channels, *channels[:-1])
        deeper = (*channels[1:], channels[-1])
        self.down = nn.ModuleList(_Down(i, o) for i, o in zip(sources, channels, strict=True))
        self.side = nn.ModuleList(
            _Side(i, s) if s else None  # type: ignore[misc]  # torch takes None as well
            for i, s in zip(sources, across, strict=True)
        )
        self.up = nn.ModuleList(_Up(s + d, o) for s, d, o in zip(across, deeper, channels, strict=True))
        self.head = nn.Conv2d(channels[0], out_channels, 1)
        self.multiple = 2**scales

    def forward(self, image: Tensor) -> Tensor:
        """Map (batch, in_channels, height, width) to (batch, out_channels, height, width)."""
        height, width = image.shape[2:]
        # The coarsest scale needs two pixels each way: one pixel can neither be mirrored nor normalised.
        x = mirror_to_multiple(image, self.multiple, at_least=2 * self.multiple)
        sides: list[Tensor | None] = []
        for down, side in zip(self.down, self.side, strict=True):
            sides.append(None if side is None else side(x))
            x = down(x)
        *coarse, finest = reversed(list(zip(self.up, sides, strict=True)))
        for up, across in coarse:
            x = up(x, across)
        up, across = finest
        x = cast(Tensor, up(x, across, then=lambda y: torch.sigmoid(self.head(y))))
        return x[:, :, :height, :width]


class ResNet(nn.Module):
    """Residual blocks at full resolution: conv, norm, leaky ReLU, conv, norm, plus the identity."""

    def __init__(self, in_channels: int, out_channels: int = 3) -> None:
        super().__init__()
        width = RESNET_WIDTH
        self.first = _MirroringConv(in_channels, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(width, width, 3, padding=1, bias=False),
                _NormAct(width),
                nn.Conv2d(width, width, 3, padding=1, bias=False),
                _Norm(width),
            )
            for _ in range(RESNET_BLOCKS)
        )
        self.gather = nn.Sequential(nn.Conv2d(width, width, 3, padding=1), _Norm(width))
        self.last = _MirroringConv(width, out_channels)

    def forward(self, image: Tensor) -> Tensor:
        """Map (batch, in_channels, height, width) to (batch, out_channels, height, width)."""
        height, width = image.shape[2:]
        x = F.leaky_relu_(self.first(mirror_to_multiple(image, 1, at_least=2)), LEAKY_SLOPE)
        for block in self.blocks:
            x = x + block(x)
        return torch.sigmoid(self.last(self.gather(x)))[:, :, :height, :width]


def mirror_to_multiple(image: Tensor, multiple: int, at_least: int) -> Tensor:
    """Continue (..., height, width) below and to the right by mirroring, as often as it takes."""
    for axis in (-2, -1):
        size = image.shape[axis]
        padded = max(-(-size // multiple) * multiple, at_least)
        if padded != size:
            period = max(2 * size - 2, 1)
            step = torch.arange(padded, device=image.device) % period
            image = image.index_select(axis, torch.minimum(step, period - step))
    return image


class _Norm(nn.BatchNorm2d):
    """Batch norm that keeps no running statistics."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, NORM_EPSILON, track_running_stats=False)


class _NormAct(_Norm):
    """Batch norm, then leaky ReLU in place."""

    def forward(self, x: Tensor) -> Tensor:
        if x.dtype == torch.bfloat16 and x.device.type == "cpu" and torch.get_num_threads() <= _FEW_THREADS:
            return cast(Tensor, _NormActOnCpu.apply(x, self.weight, self.bias))  # type: ignore[no-untyped-call]
        return F.leaky_relu_(super().forward(x), LEAKY_SLOPE)


class _NormActOnCpu(torch.autograd.Function):
    """Batch norm and leaky ReLU in bfloat16, by the core: PyTorch goes through memory more often."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Take (batch, channels, height, width) and two vectors of channels."""
        ctx.shape = x.permute(0, 2, 3, 1).shape
        norm = _bits(x), weight.detach().numpy(), bias.detach().numpy(), NORM_EPSILON, LEAKY_SLOPE
        y, mean, scale = _core.norm_act(*norm)
        ctx.kept = *norm, y, mean, scale
        return _image(y, ctx.shape)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the gradients of what came in."""
        by_x, by_weight, by_bias = _core.norm_act_gradient(_bits(grad), *ctx.kept)
        return _image(by_x, ctx.shape), torch.from_numpy(by_weight), torch.from_numpy(by_bias)


def _bits(image: Tensor) -> npt.NDArray[np.uint16]:
    """The pixels of a bfloat16 image, shape (pixels, channels), as numpy can hold them."""
    rows = image.detach().permute(0, 2, 3, 1).flatten(0, 2).contiguous()
    return cast("npt.NDArray[np.uint16]", rows.view(torch.uint16).numpy())


def _image(bits: npt.NDArray[np.uint16], shape: torch.Size) -> Tensor:
    """Undo `_bits`, for an image of this shape with its channels last."""
    return torch.from_numpy(bits).view(torch.bfloat16).view(shape).permute(0, 3, 1, 2)


class _MirroringConv(nn.Conv2d):
    """A 3x3 convolution with the image mirrored at its edges."""

    def __init__(self, in_channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__(in_channels, out_channels, 3, stride)

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(_edged(x, "reflect"))


class _Down(nn.Sequential):
    """Halve the resolution."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__(
            _MirroringConv(in_channels, out_channels, stride=2),
            _NormAct(out_channels),
            _MirroringConv(out_channels, out_channels),
            _NormAct(out_channels),
        )


class _Side(nn.Sequential):
    """The connection across at one scale."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__(nn.Conv2d(in_channels, out_channels, 1), _NormAct(out_channels))


class _Up(nn.Module):
    """Double the resolution: upsample bilinearly, join what comes in, norm, 3x3, norm, act, 1x1, norm, act.

    Where nothing comes in, as at the fine scales, the 3x3 convolution repeats the edge in place of mirroring
    it. Upsampling and convolution are then together one convolution of the coarse image, with one
    kernel for each of the four pixels that a coarse pixel becomes: no large image in between.
    """

    phase_kernels: Tensor
    blur: Tensor

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.norm = _Norm(in_channels)
        self.conv = _MirroringConv(in_channels, out_channels)
        self.blend = nn.Sequential(
            _NormAct(out_channels), nn.Conv2d(out_channels, out_channels, 1), _NormAct(out_channels)
        )
        self.register_buffer("phase_kernels", _phase_kernels(), persistent=False)
        self.register_buffer("blur", _upsampling_blur(), persistent=False)

    def forward(self, coarse: Tensor, across: Tensor | None, then: Pointwise | None = None) -> Tensor:
        """Return the finer image, with ``then`` applied to it."""
        if across is None:
            y = self.blend(self._phases(coarse))
            return _image_from_phases(then(y) if then else y, coarse.shape[2], coarse.shape[3])
        fine = F.interpolate(coarse, scale_factor=2, mode="bilinear")
        y = self.blend(self.conv(self.norm(torch.cat((across, fine), 1))))
        return then(y) if then else y

    def _phases(self, coarse: Tensor) -> Tensor:
        """Equal ``conv(norm(upsample(coarse)))`` with edges repeated.

        The pixels come in the order that `_image_from_phases` undoes.
        """
        batch, _, height, width = coarse.shape
        edged = _edged(coarse, "replicate")

        mean, variance = _UpsampledMoments.apply(  # type: ignore[no-untyped-call]
            coarse, edged.detach(), self.blur
        )

        # The norm is affine, so it goes into the weights.
        scale = self.norm.weight * torch.rsqrt(variance + self.norm.eps)
        shift = self.norm.bias - mean * scale
        bias = self.conv.bias + self.conv.weight.sum((2, 3)) @ shift
        kernel = (self.conv.weight * scale[:, None, None]).flatten(2) @ self.phase_kernels
        kernel = kernel.reshape(*kernel.shape[:2], 4, 3, 3).permute(2, 0, 1, 3, 4).flatten(0, 1)
        y = F.conv2d(edged, kernel.contiguous(memory_format=torch.channels_last), bias.repeat(4))
        return y.permute(0, 2, 3, 1).reshape(batch, height, width * 4, -1).permute(0, 3, 1, 2)


class _UpsampledMoments(torch.autograd.Function):
    """Mean and variance of each channel of the upsampled image, without upsampling.

    Upsampling U keeps the mean, and the mean square of U x is the mean of x times x blurred by U'U.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, edged: Tensor, blur: Tensor) -> tuple[Tensor, Tensor]:
        """Take (batch, channels, height, width), and that with its edges repeated; return two vectors."""
        channels = x.shape[1]
        rows = _rows(x)
        mean = rows.mean(0)
        blurred = _rows(F.conv2d(edged, blur.expand(channels, 1, 3, 3), groups=channels)) - mean
        ctx.save_for_backward(blurred)
        ctx.shape = x.permute(0, 2, 3, 1).shape
        return mean, ((rows - mean) * blurred).mean(0)

    @staticmethod
    def backward(ctx: Any, grad_mean: Tensor, grad_variance: Tensor) -> tuple[Tensor, None, None]:
        """Return the gradient of x."""
        (blurred,) = ctx.saved_tensors
        pixels = len(blurred)
        grad = torch.addcmul(grad_mean / pixels, blurred, 2 * grad_variance / pixels)
        return grad.view(ctx.shape).permute(0, 3, 1, 2), None, None


def _rows(x: Tensor) -> Tensor:
    """(batch, channels, height, width) as a matrix of pixels and channels, in float32 at least.

    PyTorch goes through that ten times faster than through the same numbers as an image.
    """
    return x.permute(0, 2, 3, 1).flatten(0, 2).to(torch.promote_types(x.dtype, torch.float32))


def _edged(x: Tensor, mode: str) -> Tensor:
    """Continue an image by one pixel at every edge."""
    # Autocast would copy it into float32 to do so, and back.
    with torch.autocast(x.device.type, enabled=False):
        return F.pad(x, (1, 1, 1, 1), mode=mode)


def _image_from_phases(y: Tensor, height: int, width: int) -> Tensor:
    """Bring (batch, channels, height, width * 2 * 2) into the order of an image twice as high and wide."""
    y = y.permute(0, 2, 3, 1).reshape(y.shape[0], height, width, 2, 2, -1).transpose(2, 3)
    return y.reshape(y.shape[0], 2 * height, 2 * width, -1).permute(0, 3, 1, 2)


def _upsampling_blur() -> Tensor:
    """The 3x3 kernel of U'U, U being bilinear upsampling by 2, scaled to sum 1."""
    taps = torch.tensor([3.0, 10.0, 3.0]) / 16
    return torch.outer(taps, taps)


def _phase_kernels() -> Tensor:
    """Shape (9, 4 * 9): what a tap on the upsampled image is to the taps of each phase on the coarse one."""
    # Row r: what coarse pixels i-1, i, i+1 give to fine pixel 2i-1+r.
    fine_from_coarse = torch.tensor([[0.75, 0.25, 0], [0.25, 0.75, 0], [0, 0.75, 0.25], [0, 0.25, 0.75]])
    phases = torch.stack((fine_from_coarse[:3], fine_from_coarse[1:]))
    return torch.einsum("ptl,qsm->tspqlm", phases, phases).reshape(9, 36)
