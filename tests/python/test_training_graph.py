"""One training step as an ONNX graph, and what the network is shown."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import onnx
import pytest

from fitted_models import DRAFT, evidence_of
from synthetic import SyntheticRender, synthetic_render
from tungsten_dip.buffers.render_buffers import FloatArray, FloatImage
from tungsten_dip.fit import denoise
from tungsten_dip.fit.evidence import Cues, Evidence, with_best_baseline
from tungsten_dip.fit.layout import Layout, Pilot
from tungsten_dip.fit.model import Model
from tungsten_dip.fit.network.blend_network import (
    BlendNetwork,
    Examples,
    first_weights,
    training_step,
    weight_shapes,
)
from tungsten_dip.fit.network.inputs import INPUTS_RADIUS, inputs_of_half, loss_weights, network_inputs
from tungsten_dip.fit.network.training import start_of_training
from tungsten_dip.graphs.sessions import session_from_proto
from tungsten_dip.onnx import infer

torch = pytest.importorskip("torch")

from torch_network import TorchNetwork  # noqa: E402

PILOTS = (Pilot("features", 1), Pilot("features", 3))


def examples_for_training(seed: int = 0) -> tuple[Examples, Layout]:
    evidence, cues = evidence_of(synthetic_render(24, 20, seed=seed).buffers, PILOTS)
    return start_of_training(evidence, cues, seed, None, 1).examples, evidence.layout


@pytest.mark.parametrize("pixels", [1, 37, 480])
def test_gradients_and_updates_agree_with_torch(pixels: int) -> None:
    examples, layout = examples_for_training()
    weights = first_weights(layout, seed=3, members=1)
    rng = np.random.default_rng(4)
    for name, value in weights.items():
        weights[name] = value + rng.normal(0, 0.3, value.shape).astype(np.float32)
    batch = examples.at(rng.integers(2 * 480, size=pixels))
    batch.target[0] += 1e3

    in_torch = TorchNetwork(weights)
    in_onnx = BlendNetwork(layout, weights, "cpu")
    proto = training_step(len(layout.inputs), layout.candidate_count)
    onnx.checker.check_model(proto, full_check=True)
    vector = np.concatenate([value.ravel() for value in weights.values()])
    feeds = {
        "inputs": batch.inputs,
        "candidates": batch.candidates,
        "target": batch.target,
        "weight": batch.weight,
        "weights": vector,
        "mean": np.zeros_like(vector),
        "square": np.zeros_like(vector),
        "learning_rate": np.array([1e-2], np.float32),
        "step": np.array([1], np.float32),
    }
    gradient, loss = session_from_proto(proto, 1).run(["gradient", "loss"], feeds)

    expected = np.concatenate([part.numpy().ravel() for part in in_torch.gradients(batch)])
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())
    assert loss == pytest.approx(in_torch.loss(batch).item(), rel=1e-4)

    for _ in range(5):
        for network in (in_torch, in_onnx):
            network.step(batch, 1e-2)
    for name, value in in_torch.weights().items():
        np.testing.assert_allclose(in_onnx.weights()[name].reshape(value.shape), value, rtol=1e-3, atol=1e-3)


def denoised(network: BlendNetwork, examples: Examples) -> FloatArray:
    return network.blend(examples.inputs, examples.candidates.swapaxes(0, 1))


def test_members_are_networks_by_themselves_and_their_mean_is_the_image() -> None:
    examples, layout = examples_for_training()
    weights = first_weights(layout, seed=3, members=3)
    together = BlendNetwork(layout, weights, "cpu", threads=2)
    parts = {name: np.split(value, 3) for name, value in weights.items()}
    alone = [BlendNetwork(layout, {name: part[k] for name, part in parts.items()}, "cpu") for k in range(3)]
    for first in range(0, 300, 100):
        for network in (together, *alone):
            network.step(examples.part(first, first + 100), 1e-2)
    images = [denoised(network, examples) for network in alone]
    assert not np.array_equal(images[0], images[1])
    np.testing.assert_array_equal(denoised(together, examples), sum(images) / np.float32(3))
    for name, value in together.weights().items():
        np.testing.assert_array_equal(value, np.concatenate([network.weights()[name] for network in alone]))


@pytest.mark.parametrize("outlier", [1.0, 1e3])
def test_gradients_are_those_of_the_loss(outlier: float) -> None:
    """Against central differences in double precision, without torch."""
    rng = np.random.default_rng(0)
    inputs, candidates, pixels = 3, 2, 5
    shapes = weight_shapes(inputs, candidates)
    vector = rng.normal(0, 0.5, sum(int(np.prod(s)) for s in shapes.values()))
    feeds = {
        "inputs": rng.normal(size=(pixels, inputs)),
        "candidates": rng.random((pixels, candidates, 3)),
        "target": rng.random((pixels, 3)),
        "weight": rng.random((pixels, 1)),
    }
    feeds["target"][0] *= outlier

    def loss(weights: Any) -> float:
        x, first = feeds["inputs"], 0
        for layer in (1, 2, 3):
            parts = []
            for name in ("weight", "bias"):
                shape = shapes[f"layer{layer}.{name}"]
                parts.append(weights[first : first + int(np.prod(shape))].reshape(shape))
                first += int(np.prod(shape))
            x = x @ parts[0].T + parts[1]
            x = np.where(x > 0, x, 0.2 * x) if layer < 3 else x
        shares = np.exp(x) / np.exp(x).sum(1, keepdims=True)
        denoised = (shares[:, :, None] * feeds["candidates"]).sum(1)
        error = np.sqrt((feeds["weight"] * (denoised - feeds["target"]) ** 2).mean(axis=1))
        assert (error > 30).any() == (outlier > 1)
        return float(np.where(error > 30, 60 * error - 900, error**2).mean())

    expected = [(loss(vector + d) - loss(vector - d)) / 2e-6 for d in 1e-6 * np.eye(vector.size)]
    zeros = np.zeros(vector.size, np.float32)
    single = {name: value.astype(np.float32) for name, value in {**feeds, "weights": vector}.items()}
    one = np.ones(1, np.float32)
    state = {"mean": zeros, "square": zeros, "learning_rate": one, "step": one}
    gradient = session_from_proto(training_step(inputs, candidates), 1).run(
        ["gradient"], {**single, **state}
    )[0]
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_a_refit_does_what_a_warm_start_does(model: Model, next_frame: SyntheticRender) -> None:
    refit = infer(model, next_frame.buffers, threads=1, refit_steps=30)
    warm = denoise(next_frame.buffers, replace(DRAFT, iterations=30), warm_start=model)
    assert 0 < refit.iterations == warm.iterations <= 30
    np.testing.assert_allclose(refit.color, warm.color, rtol=1e-3)
    assert refit.model is not None
    assert refit.model.source_sha256 != model.source_sha256
    assert refit.model.settings.iterations == 30
    again = infer(refit.model, next_frame.buffers, threads=1)
    np.testing.assert_allclose(again.color, refit.color, rtol=1e-5)


def test_inputs_in_bands_are_those_of_the_whole(frame: SyntheticRender) -> None:
    evidence, cues = evidence_of(frame.buffers, PILOTS)

    def of_rows(first: int, end: int) -> FloatArray:
        inputs = network_inputs(
            evidence.layout, evidence.candidates.rows(first, end), cues.rows(first, end), 1
        )
        return inputs.reshape(2, end - first, 48, -1)

    whole, upper, lower = of_rows(0, 32), of_rows(0, 28), of_rows(4, 32)
    inner = 28 - INPUTS_RADIUS
    np.testing.assert_allclose(upper[:, :inner], whole[:, :inner], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(lower[:, -inner:], whole[:, -inner:], rtol=1e-3, atol=1e-3)


def _inputs_of_half_a(evidence: Evidence, cues: Cues) -> FloatArray:
    """Return the inputs of half A, shape (height, width, inputs)."""
    return np.stack(list(inputs_of_half(evidence.layout, evidence.candidates, cues, 0, 1)), axis=2)


def _with_noisy(evidence: Evidence, half_a: FloatImage, half_b: FloatImage) -> Evidence:
    return replace(evidence, candidates=replace(evidence.candidates, noisy=(half_a, half_b)))


def test_the_network_sees_its_halfs_noise_of_no_pixel_at_that_pixel(frame: SyntheticRender) -> None:
    """Or it would prefer a noisy pixel for being dark."""
    evidence, cues = evidence_of(frame.buffers, PILOTS)
    y, x = 11, 17
    half_a, half_b = evidence.candidates.noisy
    changed = half_a.copy()
    changed[y, x] *= 3
    before = _inputs_of_half_a(evidence, cues)
    after = _inputs_of_half_a(_with_noisy(evidence, changed, half_b), cues)
    np.testing.assert_allclose(after[y, x], before[y, x], rtol=1e-3, atol=1e-3)
    assert np.abs(after - before).max() > 0.01


def test_the_network_sees_the_scoring_halfs_noise_of_no_pixel_at_that_pixel(frame: SyntheticRender) -> None:
    """Nor may the weight of the pixel in the loss depend on it, or the image would darken."""
    evidence, cues = evidence_of(frame.buffers, PILOTS)
    before = _inputs_of_half_a(evidence, cues)
    half_a, half_b = evidence.candidates.noisy
    largest_change = 0.0
    for y in range(3, 32, 4):
        for x in range(3, 48, 4):
            changed = half_b.copy()
            changed[y, x] = 5 * changed[y, x] + 0.1
            # As a fit does: the noise is estimated with the same half.
            other, other_cues = with_best_baseline(_with_noisy(evidence, half_a, changed), cues)
            assert other.layout == evidence.layout
            after = _inputs_of_half_a(other, other_cues)
            np.testing.assert_allclose(after[y, x], before[y, x], rtol=1e-3, atol=1e-3)
            largest_change = max(largest_change, float(np.abs(after - before).max()))
            weights = (loss_weights(c)[0][y, x, 0] for c in (cues, other_cues))
            assert next(weights) == pytest.approx(next(weights), rel=1e-3)
    assert largest_change > 0.1
