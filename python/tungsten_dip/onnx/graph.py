"""The graphs of the networks: what `fit.network` and `fit.paper` compute, in plain operators.

The height and width of the inputs are free. The images of a batch are independent: the batch
norms of the preset paper, which always use the statistics of the batch in hand, are instance norms here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto

from tungsten_dip.errors import InputError
from tungsten_dip.fit.model import Model, Weights
from tungsten_dip.fit.network.blend_network import HIDDEN, members_of
from tungsten_dip.fit.network.blend_network import LEAKY_SLOPE as BLEND_SLOPE
from tungsten_dip.fit.paper.constants import (
    LEAKY_SLOPE,
    NORM_EPSILON,
    RESNET_BLOCKS,
    RESNET_WIDTH,
    SIDE_CHANNELS,
    SIDE_SCALES,
)
from tungsten_dip.fit.standardisation import LARGEST_INPUT
from tungsten_dip.graphs.builder import GraphBuilder

_MOST_MEMBERS = 16
"""Members of a blend network: the memory that it takes grows with them."""


def graph_of(model: Model, metadata: dict[str, str] | None = None) -> onnx.ModelProto:
    """Return the model's network with its weights.

    Kind blend: ``inputs`` (N, inputs, H, W), as they come, and ``candidates`` (N, candidates, 3, H, W) give
    ``color`` (N, 3, H, W). Others: ``inputs`` (N, inputs, H, W) give ``color`` (N, outputs, H, W), colour
    first.

    Raises InputError if the model's weights are not those of its network.
    """
    build = _Network(model.weights)
    inputs = len(model.inputs)
    shapes: dict[str, tuple[int | str, ...]] = {"inputs": ("N", inputs, "H", "W")}
    outputs = 3
    if model.blend is not None:
        candidates = model.blend.layout.candidate_count
        shapes["candidates"] = ("N", candidates, 3, "H", "W")
        mean, std = model.blend.standardisation.mean, model.blend.standardisation.std
        if not mean.shape == std.shape == (inputs,):
            raise InputError(f"the model has constants for {mean.size} inputs, and {inputs} inputs")
        build.blend(inputs, candidates, mean, std)
    else:
        name = "head.bias" if model.kind == "skip" else "last.bias"
        outputs = model.weights[name].size if name in model.weights else 3
        if model.kind == "skip":
            build.skip(inputs, outputs, model.settings.channels)
        else:
            build.resnet(inputs, outputs)
    build.check_all_used()
    return build.model(
        model.kind, shapes, {"color": ("N", outputs, "H", "W")}, metadata, version=model.version
    )


class _Network(GraphBuilder):
    """Adds layers that take their weights by name, and checks the shapes of those."""

    def __init__(self, weights: Weights) -> None:
        super().__init__()
        self._weights = weights
        self._used: set[str] = set()

    def blend(
        self, inputs: int, candidates: int, mean: npt.NDArray[np.float64], std: npt.NDArray[np.float32]
    ) -> None:
        """Standardise, compute the candidates' weights, blend them."""
        # In double precision, as in the fit: an input may vary by little around a large mean.
        exact = self.add("Cast", "inputs", to=TensorProto.DOUBLE)
        centred = self.add("Sub", exact, self.constant("mean", mean.reshape(-1, 1, 1)))
        centred = self.add("Cast", centred, to=TensorProto.FLOAT)
        x = self.add("Div", centred, self.constant("std", std.reshape(-1, 1, 1)))
        x = self.add("Clip", x, self.number(-LARGEST_INPUT), self.number(LARGEST_INPUT))
        members = members_of(self._weights)
        if members > _MOST_MEMBERS:
            raise InputError(f"the model has {members} members: expected at most {_MOST_MEMBERS}")
        hidden = members * HIDDEN
        x = self.leaky(self.conv(x, "layer1", inputs, hidden), BLEND_SLOPE)
        x = self.leaky(self.conv(x, "layer2", hidden, hidden, groups=members), BLEND_SLOPE)
        x = self.conv(x, "layer3", hidden, members * candidates, groups=members)
        if members == 1:
            x = self.add("Softmax", x, axis=1)
        else:
            parts = self.split(x, [candidates] * members, axis=1)
            x = self.add("Mean", *(self.add("Softmax", part, axis=1) for part in parts))
        weighted = self.add("Mul", self.add("Unsqueeze", x, self.integers(2)), "candidates")
        self.add("ReduceSum", weighted, self.integers(1), keepdims=0, output="color")

    def skip(self, inputs: int, outputs: int, channels: tuple[int, ...]) -> None:
        """Encoder and decoder, as `tungsten_dip.fit.paper.networks.Skip`."""
        scales = len(channels)
        sources, deeper = (inputs, *channels[:-1]), (*channels[1:], channels[-1])
        x = self.mirrored("inputs", 2**scales, at_least=2 ** (scales + 1))
        sides: list[str | None] = []
        for scale, (before, after) in enumerate(zip(sources, channels, strict=True)):
            across = scale >= scales - SIDE_SCALES
            side = f"side.{scale}"
            sides.append(
                self.norm_act(self.conv(x, f"{side}.0", before, SIDE_CHANNELS), f"{side}.1", SIDE_CHANNELS)
                if across
                else None
            )
            down = f"down.{scale}"
            x = self.conv(self.padded(x, "reflect"), f"{down}.0", before, after, size=3, stride=2)
            x = self.norm_act(x, f"{down}.1", after)
            x = self.conv(self.padded(x, "reflect"), f"{down}.2", after, after, size=3)
            x = self.norm_act(x, f"{down}.3", after)
        for scale in reversed(range(scales)):
            up, after, coming = f"up.{scale}", channels[scale], deeper[scale]
            x = self.add(
                "Resize",
                x,
                "",
                self.constant("double", np.array([1, 1, 2, 2], np.float32)),
                mode="linear",
                coordinate_transformation_mode="half_pixel",
            )
            side_of_scale = sides[scale]
            if side_of_scale is not None:
                x = self.add("Concat", side_of_scale, x, axis=1)
                coming += SIDE_CHANNELS
            x = self.norm(x, f"{up}.norm", coming)
            x = self.padded(x, "edge" if side_of_scale is None else "reflect")
            x = self.conv(x, f"{up}.conv", coming, after, size=3)
            x = self.conv(self.norm_act(x, f"{up}.blend.0", after), f"{up}.blend.1", after, after)
            x = self.norm_act(x, f"{up}.blend.2", after)
        self.cropped(self.add("Sigmoid", self.conv(x, "head", channels[0], outputs)))

    def resnet(self, inputs: int, outputs: int) -> None:
        """Residual blocks, as `tungsten_dip.fit.paper.networks.ResNet`."""
        width = RESNET_WIDTH
        x = self.padded(self.mirrored("inputs", 1, at_least=2), "reflect")
        x = self.leaky(self.conv(x, "first", inputs, width, size=3))
        for block in (f"blocks.{index}" for index in range(RESNET_BLOCKS)):
            y = self.conv(self.padded(x, "constant"), f"{block}.0", width, width, size=3, bias=False)
            y = self.padded(self.norm_act(y, f"{block}.1", width), "constant")
            y = self.conv(y, f"{block}.2", width, width, size=3, bias=False)
            x = self.add("Add", x, self.norm(y, f"{block}.3", width))
        x = self.conv(self.padded(x, "constant"), "gather.0", width, width, size=3)
        x = self.padded(self.norm(x, "gather.1", width), "reflect")
        self.cropped(self.add("Sigmoid", self.conv(x, "last", width, outputs, size=3)))

    def conv(
        self,
        x: str,
        name: str,
        inputs: int,
        outputs: int,
        size: int = 1,
        stride: int = 1,
        bias: bool = True,
        groups: int = 1,
    ) -> str:
        """Convolve, without padding."""
        weights = [self.weight(f"{name}.weight", (outputs, inputs // groups, size, size))]
        if bias:
            weights.append(self.weight(f"{name}.bias", (outputs,)))
        grouped: dict[str, Any] = {"group": groups} if groups > 1 else {}
        return self.add("Conv", x, *weights, kernel_shape=[size, size], strides=[stride, stride], **grouped)

    def norm(self, x: str, name: str, channels: int) -> str:
        """Normalise every image and channel by itself."""
        weight, shift = (
            self.add("Unsqueeze", self.weight(f"{name}.{what}", (channels,)), self.integers(1, 2))
            for what in ("weight", "bias")
        )
        offset = self.add("Sub", x, self.pixel_mean(x))
        variance = self.pixel_mean(self.add("Mul", offset, offset))
        std = self.add("Sqrt", self.add("Add", variance, self.number(NORM_EPSILON)))
        return self.add("Add", self.add("Mul", offset, self.add("Div", weight, std)), shift)

    def pixel_mean(self, x: str) -> str:
        """Return the mean over height and width."""
        # Row by row: the operator InstanceNormalization sums millions of pixels in one go and loses digits.
        rows = self.add("ReduceMean", x, self.integers(3))
        return self.add("ReduceMean", rows, self.integers(2))

    def leaky(self, x: str, slope: float = LEAKY_SLOPE) -> str:
        """Apply a leaky ReLU."""
        return self.add("LeakyRelu", x, alpha=slope)

    def norm_act(self, x: str, name: str, channels: int) -> str:
        """Normalise, then leaky ReLU."""
        return self.leaky(self.norm(x, name, channels))

    def padded(self, x: str, mode: str) -> str:
        """Continue an image by one pixel to all sides."""
        return self.add("Pad", x, self.integers(0, 0, 1, 1, 0, 0, 1, 1), mode=mode)

    def mirrored(self, x: str, multiple: int, at_least: int) -> str:
        """Continue below and to the right, as `tungsten_dip.fit.paper.networks.mirror_to_multiple`."""
        one = self.integers(1)
        for axis in (2, 3):
            size = self.add("Shape", x, start=axis, end=axis + 1)
            steps = self.add(
                "Div", self.add("Add", size, self.integers(multiple - 1)), self.integers(multiple)
            )
            padded = self.add("Mul", steps, self.integers(multiple))
            padded = self.add("Max", padded, self.integers(at_least))
            period = self.add("Sub", self.add("Mul", size, self.integers(2)), self.integers(2))
            period = self.add("Max", period, one)
            zero, by = (self.constant(f"scalar {value}", np.array(value, np.int64)) for value in (0, 1))
            index = self.add("Range", zero, self.add("Squeeze", padded), by)
            index = self.add("Mod", index, period)
            index = self.add("Min", index, self.add("Sub", period, index))
            x = self.add("Gather", x, index, axis=axis)
        return x

    def cropped(self, x: str) -> None:
        """Crop the output to the height and width of the inputs."""
        size = self.add("Shape", "inputs", start=2, end=4)
        self.add("Slice", x, self.integers(0, 0), size, self.integers(2, 3), output="color")

    def weight(self, name: str, shape: tuple[int, ...]) -> str:
        """Add a weight of this shape."""
        given: Any = self._weights.get(name)
        if given is None or given.shape != shape:
            found = "none" if given is None else f"shape {given.shape}"
            raise InputError(f"the model's weight {name}: expected shape {shape}, found {found}")
        self._used.add(name)
        return self.constant(name, given)

    def check_all_used(self) -> None:
        """Raise InputError if there is a weight that no layer has taken."""
        unused = self._weights.keys() - self._used
        if unused:
            raise InputError(f"the model's weight {min(unused)}: its network has none of that name")
