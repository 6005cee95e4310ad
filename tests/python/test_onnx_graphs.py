"""Exported networks compute what the fits do: onnxruntime agrees with torch, at sizes never exported."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import given, settings, strategies

from fitted_models import DRAFT, paper_model, session_of
from synthetic import SyntheticRender, synthetic_render
from tungsten_dip.buffers.render_buffers import Buffer
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitResult, FitSettings, denoise, inference
from tungsten_dip.fit.blending import fit_blend
from tungsten_dip.fit.inference import infer_blend
from tungsten_dip.fit.layout import Layout, Pilot
from tungsten_dip.fit.model import Blend, Model
from tungsten_dip.fit.network.blend_network import Examples, first_weights
from tungsten_dip.fit.standardisation import Standardisation
from tungsten_dip.onnx import infer
from tungsten_dip.onnx.file import proto_from_model
from tungsten_dip.progress import silent

torch = pytest.importorskip("torch")

from torch_network import TorchNetwork  # noqa: E402

SIZES = [(1, 1), (7, 5), (33, 65), (1, 64)]
"""None of them is the size of a fit."""


def test_the_checker_passes_and_height_and_width_are_free(model: Model, frame: SyntheticRender) -> None:
    for each in (model, paper_model("skip", frame.buffers), paper_model("resnet", frame.buffers)):
        proto = proto_from_model(each)
        onnx.checker.check_model(proto, full_check=True)
        assert [(entry.domain, entry.version) for entry in proto.opset_import] == [("", 18)]
        for value in (*proto.graph.input, *proto.graph.output):
            dims = [dim.dim_param for dim in value.type.tensor_type.shape.dim]
            assert dims[0] == "N"
            assert dims[-2:] == ["H", "W"]


def test_inference_mixes_all_samples_as_the_fit_does_whatever_its_time_budget(frame: SyntheticRender) -> None:
    for time_budget_s in (None, 1e9):
        settings = replace(DRAFT, preset="balanced", iterations=5, time_budget_s=time_budget_s)
        fitted = denoise(frame.buffers, settings)
        assert fitted.model is not None
        assert fitted.halves is not None
        assert not np.allclose(fitted.color, (fitted.halves[0] + fitted.halves[1]) / 2, rtol=1e-3)
        inferred = infer(fitted.model, frame.buffers, threads=1)
        np.testing.assert_allclose(inferred.color, fitted.color, rtol=1e-4, atol=1e-5)


def test_inference_means_over_members_as_the_fit_does(frame: SyntheticRender) -> None:
    fitted = denoise(frame.buffers, replace(DRAFT, preset="final", iterations=5))
    assert fitted.model is not None
    onnx.checker.check_model(proto_from_model(fitted.model), full_check=True)
    inferred = infer(fitted.model, frame.buffers, threads=1)
    np.testing.assert_allclose(inferred.color, fitted.color, rtol=1e-4, atol=1e-5)
    again = denoise(frame.buffers, replace(DRAFT, preset="final", iterations=5), warm_start=fitted.model)
    assert again.model is not None
    assert again.model.weights["layer1.bias"].shape == fitted.model.weights["layer1.bias"].shape


def test_inference_repeats_the_fit(fitted: FitResult, model: Model, frame: SyntheticRender) -> None:
    inferred = infer(model, frame.buffers, threads=1)
    np.testing.assert_array_equal(inferred.color, fitted.color)
    assert inferred.halves is not None
    assert fitted.halves is not None
    np.testing.assert_array_equal(inferred.halves, fitted.halves)
    assert inferred.estimated_relmse == fitted.estimated_relmse
    assert inferred.iterations == 0
    assert inferred.model is model


@pytest.mark.parametrize("size", SIZES)
def test_a_blend_agrees_with_torch_at_sizes_never_exported(size: tuple[int, int], model: Model) -> None:
    assert model.blend is not None
    rng = np.random.default_rng(0)
    height, width = size
    inputs = rng.normal(0, 2, (2, len(model.inputs), height, width)).astype(np.float32)
    candidates = rng.random((2, model.blend.layout.candidate_count, 3, height, width), np.float32)
    color = session_of(model).run(None, {"inputs": inputs, "candidates": candidates})[0]
    assert color.shape == (2, 3, height, width)

    flat = inputs.reshape(2, len(model.inputs), -1).transpose(0, 2, 1).copy()
    model.blend.standardisation.apply(flat, threads=1)
    flat_candidates = (
        candidates.reshape(2, model.blend.layout.candidate_count, 3, -1).transpose(0, 3, 1, 2).copy()
    )
    network = TorchNetwork(model.weights)
    for half in (0, 1):
        examples = Examples(flat[half], flat_candidates[half], flat_candidates[half, :, 0], flat[half, :, :1])
        expected = network.blend(examples).T.reshape(3, height, width)
        np.testing.assert_allclose(color[half], expected, rtol=1e-4)


# One pixel is left out for Skip: its norms see constants, and raise rounding by 1 / sqrt(epsilon) each.
@pytest.mark.parametrize("size", [*SIZES[1:], (70, 34)])
@pytest.mark.parametrize("channels", [(4, 6, 8), (5,)])
def test_skip_agrees_with_torch(
    size: tuple[int, int], channels: tuple[int, ...], frame: SyntheticRender
) -> None:
    from tungsten_dip.fit.paper.networks import Skip

    fit = paper_model("skip", frame.buffers, channels=channels)
    network = Skip(len(fit.inputs), 3, channels)
    check_paper(fit, network, size)


@pytest.mark.parametrize("size", [*SIZES, (40, 18)])
def test_resnet_agrees_with_torch(size: tuple[int, int], frame: SyntheticRender) -> None:
    from tungsten_dip.fit.paper.networks import ResNet

    fit = paper_model("resnet", frame.buffers, scheme="ioc")
    assert fit.inputs == ("random 0", "random 1", "random 2")
    outputs = fit.weights["last.bias"].size
    assert outputs > 3
    check_paper(fit, ResNet(len(fit.inputs), outputs), size)


def check_paper(fit: Model, network: Any, size: tuple[int, int]) -> None:
    network.load_state_dict({name: torch.from_numpy(weight) for name, weight in fit.weights.items()})
    image = np.random.default_rng(1).random((1, len(fit.inputs), *size), np.float32)
    with torch.no_grad():
        expected = network(torch.from_numpy(image)).numpy()
    np.testing.assert_allclose(session_of(fit).run(None, {"inputs": image})[0], expected, rtol=1e-4)


def test_a_paper_model_gives_its_networks_output(frame: SyntheticRender) -> None:
    from tungsten_dip.buffers.display import radiance_from_ldr
    from tungsten_dip.fit.paper.images import network_input, paper_images
    from tungsten_dip.fit.paper.networks import Skip

    fit = paper_model("skip", frame.buffers)
    result = infer(fit, frame.buffers, threads=1)
    network = Skip(len(fit.inputs), 3, fit.settings.channels)
    network.load_state_dict({name: torch.from_numpy(weight) for name, weight in fit.weights.items()})
    from tungsten_dip.buffers.sanitize import sanitize

    shown = network_input(paper_images(sanitize(frame.buffers, 1)[0], fit.settings), fit.settings.seed)
    with torch.no_grad():
        output = network(torch.from_numpy(shown.transpose(2, 0, 1)[None].copy()))[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(result.color, radiance_from_ldr(output), rtol=1e-3)
    assert result.estimated_relmse is None
    with pytest.raises(InputError, match="expected 0 steps of a network of preset paper, got 1"):
        infer(fit, frame.buffers, refit_steps=1)


def test_an_input_that_varies_little_around_a_large_mean_keeps_its_digits() -> None:
    layout = Layout(("depth.Z",), (Pilot("features", 1),), 0, 1)
    inputs = len(layout.inputs)
    rng = np.random.default_rng(0)
    raw = np.full((2, inputs, 6, 7), 1e4, np.float32)
    raw += rng.integers(-9, 9, raw.shape).astype(np.float32) / 256
    flat = raw.reshape(2, inputs, -1).transpose(0, 2, 1).copy()
    mean = np.full(inputs, 1e4 + 1e-5)
    standardisation = Standardisation(mean, np.full(inputs, 0.02, np.float32))
    weights = first_weights(layout, 0, 1)
    weights["layer3.weight"] = rng.normal(size=weights["layer3.weight"].shape).astype(np.float32)
    fit = Model(layout.inputs, weights, FitSettings(), None, "", Blend(layout, standardisation))
    candidates = rng.random((2, 2, 3, 6, 7), np.float32)
    color = session_of(fit).run(None, {"inputs": raw, "candidates": candidates})[0]
    standardisation.apply(flat, threads=1)
    x = flat.astype(np.float64)
    for layer in (1, 2, 3):
        x = x @ weights[f"layer{layer}.weight"][:, :, 0, 0].T + weights[f"layer{layer}.bias"]
        x = np.where(x > 0, x, 0.2 * x) if layer < 3 else x
    shares = np.exp(x) / np.exp(x).sum(2, keepdims=True)
    expected = np.einsum("hps,hscp->hcp", shares, candidates.reshape(2, 2, 3, -1))
    np.testing.assert_allclose(color.reshape(2, 3, -1), expected, rtol=1e-5)


def test_bands_make_no_difference(
    model: Model, next_frame: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = infer(model, next_frame.buffers, threads=1)
    monkeypatch.setattr(inference, "_BAND_PIXELS", 5 * 48)
    np.testing.assert_allclose(infer(model, next_frame.buffers, threads=1).color, whole.color, rtol=1e-4)


@settings(max_examples=20, deadline=None)
@given(height=strategies.integers(1, 20), width=strategies.integers(1, 20), seed=strategies.integers(0, 99))
def test_inference_takes_any_size(height: int, width: int, seed: int, model: Model) -> None:
    buffers = synthetic_render(height, width, seed=seed).buffers
    try:
        result = infer(model, buffers, threads=1)
    except InputError as error:
        # So small an image may lack all of a feature's variation, never the feature.
        raise AssertionError(error) from error
    assert result.color.shape == (height, width, 3)
    assert np.isfinite(result.color).all()
    assert result.color.min() >= 0


def test_a_feature_that_is_constant_in_another_frame_is_shown_as_such(
    model: Model, next_frame: SyntheticRender
) -> None:
    depth = next_frame.buffers.depth
    assert depth is not None
    flat = Buffer(*(np.full_like(array, 0.5 if name != "variance" else 0) for name, array in depth.planes()))
    result = infer(model, next_frame.buffers.with_quantities(depth=flat), threads=1)
    noisy = next_frame.buffers.color.mean
    assert np.mean((result.color - next_frame.reference) ** 2) < np.mean((noisy - next_frame.reference) ** 2)


def test_without_halves_the_noise_is_split(model: Model, frame: SyntheticRender) -> None:
    buffers = frame.buffers.with_quantities(color=Buffer(frame.buffers.color.mean))
    noisy = np.mean((frame.buffers.color.mean - frame.reference) ** 2)
    for steps in (0, 5):
        result = infer(model, buffers, threads=1, refit_steps=steps)
        assert any("no half buffers" in note for note in result.notes)
        assert np.mean((result.color - frame.reference) ** 2) < noisy / 4


def test_extra_pilots_reach_the_network(frame: SyntheticRender) -> None:
    truth = frame.reference
    fit = fit_blend(frame.buffers, DRAFT, silent, previous=(truth, truth))
    assert fit.model is not None
    inferred = infer_blend(fit.model, frame.buffers, DRAFT, silent, previous=(truth, truth))
    np.testing.assert_allclose(inferred.color, fit.color, rtol=1e-5)
    with pytest.raises(InputError, match=r"fitted with 1 extra pilots .*, this input comes with 0"):
        infer(fit.model, frame.buffers)


def test_onnxruntime_uses_as_many_threads_as_it_may(
    model: Model, frame: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    original = ort.InferenceSession

    def session(content: bytes, options: ort.SessionOptions, providers: list[str]) -> Any:
        seen.append((options.intra_op_num_threads, providers))
        return original(content, options, providers=providers)

    monkeypatch.setattr(ort, "InferenceSession", session)
    infer(model, frame.buffers, threads=1)
    assert {threads for threads, _ in seen} == {1}
    assert all(providers[-1] == "CPUExecutionProvider" for _, providers in seen)
    with pytest.raises(InputError, match="threads"):
        infer(model, frame.buffers, threads=0)
    for steps in (-1, 1.5, "2", None):
        with pytest.raises(InputError, match="refit_steps: expected a whole number from 0 to"):
            infer(model, frame.buffers, refit_steps=steps)  # type: ignore[arg-type]


def test_weights_that_overflow_are_refused(model: Model, frame: SyntheticRender) -> None:
    weights = {name: np.full_like(weight, 3e38) for name, weight in model.weights.items()}
    with pytest.raises(InputError, match="no finite image"):
        infer(replace(model, weights=weights), frame.buffers, threads=1)
