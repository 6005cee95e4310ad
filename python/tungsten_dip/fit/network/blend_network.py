"""The network that blends pilots, pixel by pixel, and its training.

It may be several networks of one shape, its members, that start from different weights and use the same
examples; the error of their mean is below that of each.

A training step (forward, loss, gradients and the update of Adam, Kingma and Ba 2015) is one ONNX graph of
plain operators. For a network as small as this one onnxruntime takes less time than torch, and loads in a
fiftieth of it. Weights and moments go in and come out as one vector each, so that the update is written
once. The number of pixels is free.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import onnx

from tungsten_dip.buffers.render_buffers import FloatArray, FloatImage, Indices
from tungsten_dip.cores import in_parallel
from tungsten_dip.fit.layout import Layout
from tungsten_dip.fit.model import Weights, check_finite
from tungsten_dip.graphs.builder import GraphBuilder
from tungsten_dip.graphs.sessions import Device, session_from_proto

HIDDEN = 16
LEAKY_SLOPE = 0.2
ADAM_BETAS = (0.9, 0.999)
ADAM_EPSILON = 1e-8

_HEAD_START = 1.0
"""Logit that the best single pilot starts with."""

_HUBER_THRESHOLD = 30.0
"""A pixel's weighted error that pulls no harder however much larger it is (Huber 1964): a hundred pixels that
one half's samples found by chance would teach the network all it learns."""

_RUN_PIXELS = 1 << 14
"""Pixels that the network processes at once: the outputs of its layers stay in the processor's cache."""


@dataclass(frozen=True)
class Examples:
    """What a network is trained on: pixels of an image, those of half A first, or some of them.

    ``inputs`` has shape (pixels, inputs), ``candidates`` (pixels, candidates, 3), ``target``, the other
    half's colour, (pixels, 3), and ``weight``, of the squared error, (pixels, 1).
    """

    inputs: FloatArray
    candidates: FloatArray
    target: FloatArray
    weight: FloatArray

    def at(self, pixels: Indices) -> Examples:
        """Return a copy of some of them."""
        return Examples(*(values.take(pixels, axis=0) for values in self._arrays()))

    def part(self, first: int, end: int) -> Examples:
        """Return a view of consecutive ones."""
        return Examples(*(values[first:end] for values in self._arrays()))

    def of_half(self, half: int) -> Examples:
        """Return a view of those of one half, of a whole image's."""
        pixels = len(self.inputs) // 2
        return self.part(half * pixels, (half + 1) * pixels)

    def _arrays(self) -> tuple[FloatArray, ...]:
        return self.inputs, self.candidates, self.target, self.weight


def training_step(inputs: int, candidates: int) -> onnx.ModelProto:
    """Return the graph of one step.

    Inputs: ``inputs`` (M, inputs), standardised, ``candidates`` (M, candidates, 3), ``target`` (M, 3) and
    ``weight`` (M, 1), as in `Examples`; the vectors ``weights``, ``mean`` and ``square`` (Adam's moments)
    and the numbers (1,) ``learning_rate`` and ``step``, which counts from 1. Outputs: ``loss``, the vector
    ``gradient``, and the vectors ``next_weights``, ``next_mean`` and ``next_square``.
    """
    build = _Step()
    shapes = weight_shapes(inputs, candidates)
    size = sum(int(np.prod(shape)) for shape in shapes.values())
    gradient = build.gradient(shapes)
    build.adam(gradient)
    pixels: dict[str, tuple[int | str, ...]] = {
        "inputs": ("M", inputs),
        "candidates": ("M", candidates, 3),
        "target": ("M", 3),
        "weight": ("M", 1),
    }
    vectors = dict.fromkeys(("weights", "mean", "square"), (size,))
    numbers = dict.fromkeys(("learning_rate", "step"), (1,))
    given = {"loss": (), "gradient": (size,), **{f"next_{name}": dims for name, dims in vectors.items()}}
    return build.model("training_step", {**pixels, **vectors, **numbers}, given)


def weight_shapes(inputs: int, candidates: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of one member's weights, in the order of the vectors of `training_step`."""
    sizes = (inputs, HIDDEN, HIDDEN, candidates)
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in (1, 2, 3):
        shapes[f"layer{layer}.weight"] = (sizes[layer], sizes[layer - 1])
        shapes[f"layer{layer}.bias"] = (sizes[layer],)
    return shapes


def first_weights(layout: Layout, seed: int, members: int) -> Weights:
    """Return the weights that untrained members start from (He et al. 2015, uniform)."""
    rng = np.random.default_rng(seed)
    weights: Weights = {}
    for name, (outputs, *inputs) in weight_shapes(len(layout.inputs), layout.candidate_count).items():
        if inputs:
            bound = math.sqrt(6 / ((1 + LEAKY_SLOPE**2) * inputs[0]))
            shape = (members * outputs, *inputs, 1, 1)
            weights[name] = rng.uniform(-bound, bound, shape).astype(np.float32)
        else:
            weights[name] = np.zeros(members * outputs, np.float32)
    # Starts from the mean of the pilots that the head start gives, whatever the seed.
    weights["layer3.weight"][:] = 0
    weights["layer3.bias"][layout.baseline_index :: layout.candidate_count] = _HEAD_START
    return weights


_Member = dict[str, FloatArray]
"""The vectors of `training_step` that are a member's own."""


class BlendNetwork:
    """The members of a network and the states of their optimisers; each keeps one of ``threads`` busy."""

    def __init__(self, layout: Layout, weights: Weights, device: Device, threads: int = 1) -> None:
        inputs, candidates = len(layout.inputs), layout.candidate_count
        self._threads = threads
        self._shapes = weight_shapes(inputs, candidates)
        # The network is too small to share: threads would only wait for one another.
        self._step = session_from_proto(training_step(inputs, candidates), 1, device)
        self._blend = session_from_proto(_forward(inputs, candidates), 1, device)
        self._steps_done = 0
        self._members = self._states(weights)

    def step(self, batch: Examples, learning_rate: float) -> None:
        """Train every member on some pixels by one step of Adam: their loss falls."""
        self._steps_done += 1
        feeds = {
            "inputs": batch.inputs,
            "candidates": batch.candidates,
            "target": batch.target,
            "weight": batch.weight,
            "learning_rate": np.array([learning_rate], np.float32),
            "step": np.array([self._steps_done], np.float32),
        }

        def stepped(member: _Member) -> _Member:
            values = self._step.run([f"next_{name}" for name in member], {**feeds, **member})
            return dict(zip(member, values, strict=True))

        self._members = in_parallel(stepped, self._members, self._threads)

    def blend(self, inputs: FloatArray, candidates: Iterable[FloatImage]) -> FloatArray:
        """Return the mean of the candidates, with the weights for ``inputs``, shape (pixels, 3).

        ``inputs`` are as in `Examples`, ``candidates`` images of shape (pixels, 3) or (height, width, 3).

        Raises InputError if it is not finite.
        """
        flat = [image.reshape(-1, 3) for image in candidates]
        blended = np.empty((len(inputs), 3), np.float32)
        for first in range(0, len(blended), _RUN_PIXELS):
            part = slice(first, first + _RUN_PIXELS)
            feeds = {
                "inputs": inputs[part],
                "candidates": np.stack([image[part] for image in flat], axis=1),
            }
            by_members = (
                self._blend.run(["blended"], {**feeds, "weights": member["weights"]})[0]
                for member in self._members
            )
            blended[part] = sum(by_members) / np.float32(len(self._members))
        check_finite(blended)
        return blended

    def weights(self) -> Weights:
        """Return a copy of the weights, as those of 1x1 convolutions with a group for every member."""
        copies: Weights = {}
        first = 0
        for name, shape in self._shapes.items():
            end = first + int(np.prod(shape))
            conv_shape = (*shape, 1, 1) if len(shape) == 2 else shape
            copies[name] = np.concatenate(
                [member["weights"][first:end].reshape(conv_shape) for member in self._members]
            )
            first = end
        return copies

    def load(self, weights: Weights) -> None:
        """Replace the weights; the optimisers start anew."""
        self._steps_done = 0
        self._members = self._states(weights)

    def _states(self, weights: Weights) -> list[_Member]:
        parts = [np.split(weights[name], members_of(weights)) for name in self._shapes]
        vectors = [np.concatenate([part.ravel() for part in member]) for member in zip(*parts, strict=True)]
        return [
            {"weights": vector, "mean": np.zeros_like(vector), "square": np.zeros_like(vector)}
            for vector in vectors
        ]


def members_of(weights: Weights) -> int:
    """Return how many members have these weights, at least 1 also for weights that are no network's."""
    return max(np.size(weights.get("layer1.bias", ())) // HIDDEN, 1)


def _forward(inputs: int, candidates: int) -> onnx.ModelProto:
    """Return the graph of `BlendNetwork.blend`."""
    build = _Step()
    shapes = weight_shapes(inputs, candidates)
    build.add("Transpose", build.forward(shapes)["blended"], perm=[1, 0], output="blended")
    given: dict[str, tuple[int | str, ...]] = {
        "inputs": ("M", inputs),
        "candidates": ("M", candidates, 3),
        "weights": (sum(int(np.prod(shape)) for shape in shapes.values()),),
    }
    return build.model("forward", given, {"blended": ("M", 3)})


class _Step(GraphBuilder):
    """The parts of a step; columns of matrices are pixels, as long rows are what a processor is fast at."""

    def forward(self, shapes: dict[str, tuple[int, ...]]) -> dict[str, str]:
        """Compute the candidates' means, ``blended`` (3, M); return them, and what the gradients need."""
        sizes = [int(np.prod(shape)) for shape in shapes.values()]
        values: dict[str, str] = {}
        for (name, shape), part in zip(shapes.items(), self.split("weights", sizes), strict=True):
            as_column = self.integers(*shape) if len(shape) == 2 else self.integers(-1, 1)
            values[name] = self.add("Reshape", part, as_column)
        x = "inputs"
        for layer in (1, 2, 3):
            values[f"input{layer}"] = x
            weight, bias = values[f"layer{layer}.weight"], values[f"layer{layer}.bias"]
            # Pixels are rows in the inputs, and columns from then on.
            x = self.add("Gemm", weight, x, bias, transB=int(layer == 1))
            if layer < 3:
                x = values[f"output{layer}"] = self.add("LeakyRelu", x, alpha=LEAKY_SLOPE)
        # onnxruntime's softmax over the first axis crawls, and so do products of a matrix for every pixel.
        exp = self.add("Exp", self.add("Sub", x, self.add("ReduceMax", x, self.integers(0))))
        values["shares"] = self.add("Div", exp, self.add("ReduceSum", exp, self.integers(0)))
        count = shapes["layer3.bias"][0]
        in_rows = self.add("Reshape", "candidates", self.integers(-1, 3 * count))
        flat = self.add("Transpose", in_rows, perm=[1, 0])
        values["candidates"] = self.add("Reshape", flat, self.integers(count, 3, -1))
        shared = self.add(
            "Mul", values["candidates"], self.add("Unsqueeze", values["shares"], self.integers(1))
        )
        values["blended"] = self.add("ReduceSum", shared, self.integers(0), keepdims=0)
        return values

    def gradient(self, shapes: dict[str, tuple[int, ...]]) -> str:
        """Compute ``loss`` and return its derivatives by the weights, as one vector.

        Of pixels whose error exceeds `_HUBER_THRESHOLD`, the derivatives are those of Huber's loss.
        """
        values = self.forward(shapes)
        target, weight = (self.add("Transpose", name, perm=[1, 0]) for name in ("target", "weight"))
        difference = self.add("Sub", values["blended"], target)
        weighted = self.add("Mul", difference, weight)
        squared = self.add("ReduceMean", self.add("Mul", weighted, difference), self.integers(0))
        error, most = self.add("Sqrt", squared), self.number(_HUBER_THRESHOLD)
        bounded = self.add("Min", error, most)
        beyond = self.add("Sub", self.add("Add", error, error), bounded)
        self.add("ReduceMean", self.add("Mul", bounded, beyond), keepdims=0, output="loss")

        # loss = mean over pixels of e^2, beyond m of 2 m e - m^2, where m is `_HUBER_THRESHOLD` and
        # e^2 = mean over channels of weight * difference^2
        count = self.add("Cast", self.add("Size", "target"), to=onnx.TensorProto.FLOAT)
        pull = self.add("Div", most, self.add("Max", error, most))
        twice = self.add("Mul", pull, self.add("Div", self.number(2), count))
        by_blended = self.add("Mul", weighted, twice)
        by_share = self.add(
            "ReduceSum", self.add("Mul", values["candidates"], by_blended), self.integers(1), keepdims=0
        )
        # softmax: share * (derivative - mean of the derivatives by shares)
        mean = self.add("ReduceSum", self.add("Mul", values["shares"], by_share), self.integers(0))
        by_output = self.add("Mul", values["shares"], self.add("Sub", by_share, mean))

        flat = self.integers(-1)
        parts: dict[str, str] = {}
        for layer in (3, 2, 1):
            by_weight = self.add("Gemm", by_output, values[f"input{layer}"], transB=int(layer > 1))
            parts[f"layer{layer}.weight"] = self.add("Reshape", by_weight, flat)
            parts[f"layer{layer}.bias"] = self.add("ReduceSum", by_output, self.integers(1), keepdims=0)
            if layer > 1:
                by_input = self.add("Gemm", values[f"layer{layer}.weight"], by_output, transA=1)
                # A leaky ReLU keeps the sign.
                falls = self.add("Less", values[f"output{layer - 1}"], self.number(0))
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
