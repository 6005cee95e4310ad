"""The training step of the pointwise network as an ONNX graph of plain operators, and what runs it.

Forward, loss, gradients and the optimiser's update (Adam, Kingma and Ba 2015) are one graph, computed by
onnxruntime alone. Weights and moments go in and come out as one vector each, so that the update is written
once. The number of pixels is free.
"""

from __future__ import annotations

import numpy as np
import onnx

from tungsten_dip.fit.evidence import Array, Indices
from tungsten_dip.fit.model import Weights
from tungsten_dip.fit.training import (
    ADAM_BETAS,
    ADAM_EPSILON,
    HIDDEN,
    LEAKY_SLOPE,
    Examples,
)
from tungsten_dip.onnx.builder import GraphBuilder
from tungsten_dip.onnx.sessions import session_from_proto


def training_step(planes: int, choices: int) -> onnx.ModelProto:
    """Return the graph of one step.

    Inputs: ``inputs`` (M, planes), standardised, ``choices`` (M, pilots, 3), ``wanted`` (M, 3) and ``weight``
    (M, 1), as in `tungsten_dip.fit.training.Examples`; the vectors ``weights``, ``mean`` and ``square``
    (Adam's moments) and the numbers (1,) ``learning_rate`` and ``step``, which counts from 1. Outputs:
    ``loss``, the vector ``gradient``, and the vectors ``next_weights``, ``next_mean`` and ``next_square``.
    """
    build = _Step()
    shapes = weight_shapes(planes, choices)
    size = sum(int(np.prod(shape)) for shape in shapes.values())
    gradient = build.gradient(shapes)
    build.adam(gradient)
    pixels: dict[str, tuple[int | str, ...]] = {
        "inputs": ("M", planes),
        "choices": ("M", choices, 3),
        "wanted": ("M", 3),
        "weight": ("M", 1),
    }
    vectors = dict.fromkeys(("weights", "mean", "square"), (size,))
    numbers = dict.fromkeys(("learning_rate", "step"), (1,))
    given = {"loss": (), "gradient": (size,), **{f"next_{name}": dims for name, dims in vectors.items()}}
    return build.model("training_step", {**pixels, **vectors, **numbers}, given, metadata={}, version="")


def weight_shapes(planes: int, choices: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights, in the order in which the vectors of `training_step` hold them."""
    sizes = (planes, HIDDEN, HIDDEN, choices)
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in (1, 2, 3):
        shapes[f"layer{layer}.weight"] = (sizes[layer], sizes[layer - 1])
        shapes[f"layer{layer}.bias"] = (sizes[layer],)
    return shapes


class OnnxNetwork:
    """The network in onnxruntime; see `tungsten_dip.fit.training.Network`."""

    def __init__(self, weights: Weights, examples: Examples, threads: int) -> None:
        self._examples = examples
        planes, choices = examples.inputs.shape[2], examples.choices.shape[2]
        self._shapes = weight_shapes(planes, choices)
        self._step = session_from_proto(training_step(planes, choices), threads)
        self._fuse = session_from_proto(_forward(planes, choices), threads)
        self._weights = self._vector(weights)
        self._mean, self._square = np.zeros_like(self._weights), np.zeros_like(self._weights)
        self._steps_done = 0

    def step(self, half: Indices, pixel: Indices, learning_rate: float) -> None:
        """Do one step of Adam."""
        self._steps_done += 1
        examples = self._examples
        self._weights, self._mean, self._square = self._step.run(
            ["next_weights", "next_mean", "next_square"],
            {
                "inputs": examples.inputs[half, pixel],
                "choices": examples.choices[half, pixel],
                "wanted": examples.wanted[half, pixel],
                "weight": examples.weight[half, pixel],
                "weights": self._weights,
                "mean": self._mean,
                "square": self._square,
                "learning_rate": np.array([learning_rate], np.float32),
                "step": np.array([self._steps_done], np.float32),
            },
        )

    def fuse(self, half: int, pixel: Indices | slice) -> Array:
        """Return the weighted mean of the pilots, shape (pixels, 3)."""
        inputs, choices = self._examples.inputs[half, pixel], self._examples.choices[half, pixel]
        feeds = {"inputs": inputs, "choices": choices, "weights": self._weights}
        fused: Array = self._fuse.run(["fused"], feeds)[0]
        return fused

    def weights(self) -> Weights:
        """Return a copy of the weights, shaped as those of 1x1 convolutions."""
        copies: Weights = {}
        first = 0
        for name, shape in self._shapes.items():
            end = first + int(np.prod(shape))
            conv_shape = (*shape, 1, 1) if len(shape) == 2 else shape
            copies[name] = self._weights[first:end].reshape(conv_shape).copy()
            first = end
        return copies

    def load(self, weights: Weights) -> None:
        """Replace the weights."""
        self._weights = self._vector(weights)

    def _vector(self, weights: Weights) -> Array:
        return np.concatenate([weights[name].ravel() for name in self._shapes])


def _forward(planes: int, choices: int) -> onnx.ModelProto:
    """Return the graph of `OnnxNetwork.fuse`."""
    build = _Step()
    shapes = weight_shapes(planes, choices)
    build.forward(shapes)
    inputs: dict[str, tuple[int | str, ...]] = {
        "inputs": ("M", planes),
        "choices": ("M", choices, 3),
        "weights": (sum(int(np.prod(shape)) for shape in shapes.values()),),
    }
    return build.model("forward", inputs, {"fused": ("M", 3)}, metadata={}, version="")


class _Step(GraphBuilder):
    """The parts of a step; rows of matrices are pixels."""

    def forward(self, shapes: dict[str, tuple[int, ...]]) -> dict[str, str]:
        """Compute ``fused``; return the names of the values that the gradients need."""
        sizes = [int(np.prod(shape)) for shape in shapes.values()]
        known: dict[str, str] = {}
        for (name, shape), part in zip(shapes.items(), self.split("weights", sizes), strict=True):
            known[name] = self.add("Reshape", part, self.integers(*shape))
        x = "inputs"
        for layer in (1, 2, 3):
            known[f"input{layer}"] = x
            x = self.add("Gemm", x, known[f"layer{layer}.weight"], known[f"layer{layer}.bias"], transB=1)
            if layer < 3:
                x = known[f"output{layer}"] = self.add("LeakyRelu", x, alpha=LEAKY_SLOPE)
        known["shares"] = self.add("Softmax", x, axis=1)
        rows = self.add("Unsqueeze", known["shares"], self.integers(1))
        self.add("Squeeze", self.add("MatMul", rows, "choices"), self.integers(1), output="fused")
        return known

    def gradient(self, shapes: dict[str, tuple[int, ...]]) -> str:
        """Compute ``loss`` and return its derivatives by the weights, as one vector."""
        known = self.forward(shapes)
        difference = self.add("Sub", "fused", "wanted")
        weighted = self.add("Mul", difference, "weight")
        self.add("ReduceMean", self.add("Mul", weighted, difference), keepdims=0, output="loss")

        # loss = mean over pixels and channels of weight * difference^2
        count = self.add("Cast", self.add("Size", "fused"), to=onnx.TensorProto.FLOAT)
        by_fused = self.add("Mul", weighted, self.add("Div", self.number(2), count))
        columns = self.add("Unsqueeze", by_fused, self.integers(2))
        by_share = self.add("Squeeze", self.add("MatMul", "choices", columns), self.integers(2))
        # softmax: share * (derivative - mean of the derivatives by shares)
        mean = self.add("ReduceSum", self.add("Mul", known["shares"], by_share), self.integers(1))
        by_output = self.add("Mul", known["shares"], self.add("Sub", by_share, mean))

        flat = self.integers(-1)
        parts: dict[str, str] = {}
        for layer in (3, 2, 1):
            by_weight = self.add("Gemm", by_output, known[f"input{layer}"], transA=1)
            parts[f"layer{layer}.weight"] = self.add("Reshape", by_weight, flat)
            parts[f"layer{layer}.bias"] = self.add("ReduceSum", by_output, self.integers(0), keepdims=0)
            if layer > 1:
                by_input = self.add("MatMul", by_output, known[f"layer{layer}.weight"])
                # A leaky ReLU keeps the sign.
                falls = self.add("Less", known[f"output{layer - 1}"], self.number(0))
                slope = self.add("Where", falls, self.number(LEAKY_SLOPE), self.number(1))
                by_output = self.add("Mul", by_input, slope)
        return self.add("Concat", *(parts[name] for name in shapes), axis=0, output="gradient")

    def adam(self, gradient: str) -> None:
        """Compute the next weights and moments."""
        corrected: dict[str, str] = {}
        seen = {"mean": gradient, "square": self.add("Mul", gradient, gradient)}
        for (moment, value), beta in zip(seen.items(), ADAM_BETAS, strict=True):
            kept = self.add("Mul", moment, self.number(beta))
            new = self.add("Mul", value, self.number(1 - beta))
            self.add("Add", kept, new, output=f"next_{moment}")
            share = self.add("Sub", self.number(1), self.add("Pow", self.number(beta), "step"))
            corrected[moment] = self.add("Div", f"next_{moment}", share)
        root = self.add("Add", self.add("Sqrt", corrected["square"]), self.number(ADAM_EPSILON))
        change = self.add("Mul", self.add("Div", corrected["mean"], root), "learning_rate")
        self.add("Sub", "weights", change, output="next_weights")
