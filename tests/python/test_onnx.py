"""Models as files: torch and onnxruntime agree, nothing hostile gets in, nothing of torch is needed."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import given, settings, strategies
from onnx import TensorProto, helper

from conftest import SyntheticRender, synthetic_render
from tungsten_dip.buffers import Buffer, RenderBuffers, write_tungsten_folder
from tungsten_dip.cli import tungsten_dip as command
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitResult, FitSettings, denoise
from tungsten_dip.fit.evidence import Evidence, Layout, evidence_from_buffers
from tungsten_dip.fit.model import Model
from tungsten_dip.fit.pilots import Pilot
from tungsten_dip.fit.planes import PLANES_RADIUS, Standardisation, network_inputs, planes_of_half
from tungsten_dip.fit.pointwise import Examples, PointwiseNetwork, training_step, weight_shapes
from tungsten_dip.fit.training import first_weights, start_of_training
from tungsten_dip.graphs.sessions import session_from_proto
from tungsten_dip.onnx import file as model_file
from tungsten_dip.onnx import infer, inference, load_model, save_model
from tungsten_dip.onnx.file import proto_from_model
from tungsten_dip.onnx.graph import graph_of
from tungsten_dip.progress import silent

torch = pytest.importorskip("torch")

from torch_network import TorchNetwork  # noqa: E402

SIZES = [(1, 1), (7, 5), (33, 65), (1, 64)]
"""None of them is the size of a fit."""

DRAFT = FitSettings("draft", iterations=20, threads=1, device="cpu")


@pytest.fixture(scope="module")
def frame() -> SyntheticRender:
    return synthetic_render(32, 48)


@pytest.fixture(scope="module")
def next_frame() -> SyntheticRender:
    return synthetic_render(32, 48, seed=1)


@pytest.fixture(scope="module")
def fitted(frame: SyntheticRender) -> FitResult:
    return denoise(frame.buffers, DRAFT)


@pytest.fixture(scope="module")
def model(fitted: FitResult) -> Model:
    assert fitted.model is not None
    return fitted.model


@pytest.fixture
def saved(model: Model, tmp_path: Path) -> Path:
    save_model(tmp_path / "m.onnx", model)
    return tmp_path / "m.onnx"


def paper_model(network: str, buffers: RenderBuffers, **changes: Any) -> Model:
    chosen = {"channels": (4, 6, 8), "iterations": 1, "threads": 1, "device": "cpu", **changes}
    result = denoise(buffers, FitSettings("paper", network=network, **chosen))  # type: ignore[arg-type]
    assert result.model is not None
    return result.model


def session_of(model: Model) -> Any:
    return session_from_proto(graph_of(model, {}), 1)


def evidence_of(buffers: RenderBuffers, pilots: Any) -> Evidence:
    evidence = evidence_from_buffers(buffers, DRAFT, pilots, (), 0.0, silent)
    assert isinstance(evidence, Evidence)
    return evidence


# --- The graphs compute what the fits compute -------------------------------------------------------


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
    fitted = denoise(frame.buffers, replace(DRAFT, preset="balanced", iterations=5))
    assert fitted.model is not None
    assert fitted.halves is not None
    assert not np.allclose(fitted.color, (fitted.halves[0] + fitted.halves[1]) / 2, rtol=1e-3)
    for time_budget_s in (None, 1e-9):
        budgeted = replace(fitted.model.settings, time_budget_s=time_budget_s)
        inferred = infer(replace(fitted.model, settings=budgeted), frame.buffers, threads=1)
        np.testing.assert_allclose(inferred.color, fitted.color, rtol=1e-4, atol=1e-5)


def test_inference_repeats_the_fit(fitted: FitResult, model: Model, frame: SyntheticRender) -> None:
    inferred = infer(model, frame.buffers, threads=1)
    np.testing.assert_allclose(inferred.color, fitted.color, rtol=1e-5)
    assert inferred.halves is not None
    assert fitted.halves is not None
    for half, expected in zip(inferred.halves, fitted.halves, strict=True):
        np.testing.assert_allclose(half, expected, rtol=1e-5)
    assert inferred.estimated_relmse == pytest.approx(fitted.estimated_relmse, rel=1e-4)
    assert inferred.iterations == 0
    assert inferred.model is model


@pytest.mark.parametrize("size", SIZES)
def test_pointwise_agrees_with_torch_at_sizes_never_exported(size: tuple[int, int], model: Model) -> None:
    assert model.layout is not None
    assert model.standardisation is not None
    rng = np.random.default_rng(0)
    height, width = size
    inputs = rng.normal(0, 2, (2, len(model.planes), height, width)).astype(np.float32)
    pilots = rng.random((2, model.layout.choices, 3, height, width), np.float32)
    color = session_of(model).run(None, {"inputs": inputs, "pilots": pilots})[0]
    assert color.shape == (2, 3, height, width)

    flat = inputs.reshape(2, len(model.planes), -1).transpose(0, 2, 1).copy()
    model.standardisation.apply(flat, threads=1)
    choices = pilots.reshape(2, model.layout.choices, 3, -1).transpose(0, 3, 1, 2).copy()
    network = TorchNetwork(model.weights)
    for half in (0, 1):
        examples = Examples(flat[half], choices[half], choices[half, :, 0], flat[half, :, :1])
        expected = network.fuse(examples).T.reshape(3, height, width)
        np.testing.assert_allclose(color[half], expected, rtol=1e-4)


# One pixel is left out for Skip: its norms see constants, and raise rounding by 1 / sqrt(epsilon) each.
@pytest.mark.parametrize("size", [*SIZES[1:], (70, 34)])
@pytest.mark.parametrize("channels", [(4, 6, 8), (5,)])
def test_skip_agrees_with_torch(
    size: tuple[int, int], channels: tuple[int, ...], frame: SyntheticRender
) -> None:
    from tungsten_dip.fit.networks import Skip

    fit = paper_model("skip", frame.buffers, channels=channels)
    network = Skip(len(fit.planes), 3, channels)
    check_paper(fit, network, size)


@pytest.mark.parametrize("size", [*SIZES, (40, 18)])
def test_resnet_agrees_with_torch(size: tuple[int, int], frame: SyntheticRender) -> None:
    from tungsten_dip.fit.networks import ResNet

    fit = paper_model("resnet", frame.buffers, scheme="ioc")
    assert fit.planes == ("random 0", "random 1", "random 2")
    outputs = fit.weights["last.bias"].size
    assert outputs > 3
    check_paper(fit, ResNet(len(fit.planes), outputs), size)


def check_paper(fit: Model, network: Any, size: tuple[int, int]) -> None:
    network.load_state_dict({name: torch.from_numpy(weight) for name, weight in fit.weights.items()})
    image = np.random.default_rng(1).random((1, len(fit.planes), *size), np.float32)
    with torch.no_grad():
        expected = network(torch.from_numpy(image)).numpy()
    np.testing.assert_allclose(session_of(fit).run(None, {"inputs": image})[0], expected, rtol=1e-4)


def test_a_paper_model_gives_its_networks_output(frame: SyntheticRender) -> None:
    from tungsten_dip.fit.inputs import network_input, paper_images, radiance_from_ldr
    from tungsten_dip.fit.networks import Skip

    fit = paper_model("skip", frame.buffers)
    result = infer(fit, frame.buffers, threads=1)
    network = Skip(len(fit.planes), 3, fit.settings.channels)
    network.load_state_dict({name: torch.from_numpy(weight) for name, weight in fit.weights.items()})
    from tungsten_dip.buffers.sanitize import sanitize

    shown = network_input(paper_images(sanitize(frame.buffers, 1)[0], fit.settings), fit.settings.seed)
    with torch.no_grad():
        output = network(torch.from_numpy(shown.transpose(2, 0, 1)[None].copy()))[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(result.color, radiance_from_ldr(output), rtol=1e-3)
    assert result.estimated_relmse is None
    with pytest.raises(InputError, match="neither candidates nor refit"):
        infer(fit, frame.buffers, refit_steps=1)


def test_a_plane_that_varies_little_around_a_large_mean_keeps_its_digits() -> None:
    layout = Layout(("depth.Z",), (Pilot(1),), 0, 1)
    planes = len(layout.planes)
    rng = np.random.default_rng(0)
    raw = np.full((2, planes, 6, 7), 1e4, np.float32)
    raw += rng.integers(-9, 9, raw.shape).astype(np.float32) / 256
    flat = raw.reshape(2, planes, -1).transpose(0, 2, 1).copy()
    mean = np.full(planes, 1e4 + 1e-5)
    standardisation = Standardisation(mean, np.full(planes, 0.02, np.float32))
    weights = first_weights(layout, 0)
    weights["layer3.weight"] = rng.normal(size=weights["layer3.weight"].shape).astype(np.float32)
    fit = Model("pointwise", layout.planes, weights, FitSettings(), None, "", layout, standardisation)
    pilots = rng.random((2, 2, 3, 6, 7), np.float32)
    color = session_of(fit).run(None, {"inputs": raw, "pilots": pilots})[0]
    standardisation.apply(flat, threads=1)
    x = flat.astype(np.float64)
    for layer in (1, 2, 3):
        x = x @ weights[f"layer{layer}.weight"][:, :, 0, 0].T + weights[f"layer{layer}.bias"]
        x = np.where(x > 0, x, 0.2 * x) if layer < 3 else x
    shares = np.exp(x) / np.exp(x).sum(2, keepdims=True)
    expected = np.einsum("hps,hscp->hcp", shares, pilots.reshape(2, 2, 3, -1))
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


def test_candidates_reach_the_network(frame: SyntheticRender) -> None:
    truth = frame.reference
    fit = denoise(frame.buffers, DRAFT, candidates=[(truth, truth)])
    assert fit.model is not None
    inferred = infer(fit.model, frame.buffers, threads=1, candidates=[(truth, truth)])
    np.testing.assert_allclose(inferred.color, fit.color, rtol=1e-5)
    with pytest.raises(InputError, match="fitted with 1 candidates, this input comes with 0"):
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
    with pytest.raises(InputError, match="refit steps"):
        infer(model, frame.buffers, refit_steps=-1)


def test_weights_that_overflow_are_refused(model: Model, frame: SyntheticRender) -> None:
    weights = {name: np.full_like(weight, 3e38) for name, weight in model.weights.items()}
    with pytest.raises(InputError, match="no finite image"):
        infer(replace(model, weights=weights), frame.buffers, threads=1)


# --- Files ------------------------------------------------------------------------------------------


def assert_same(first: Model, second: Model) -> None:
    for name, value in asdict(first).items():
        if name in ("weights", "standardisation", "settings"):
            continue
        assert asdict(second)[name] == value
    assert first.weights.keys() == second.weights.keys()
    for name, weight in first.weights.items():
        np.testing.assert_array_equal(second.weights[name], weight)
    if first.standardisation is not None:
        assert second.standardisation is not None
        np.testing.assert_array_equal(second.standardisation.mean, first.standardisation.mean)
        np.testing.assert_array_equal(second.standardisation.std, first.standardisation.std)


def test_round_trip(model: Model, saved: Path) -> None:
    loaded = load_model(saved)
    assert_same(model, loaded)
    assert loaded.settings.preset == "draft"
    assert loaded.settings.iterations == 20
    assert (len(loaded.source_sha256), loaded.version) == (64, model.version)
    save_model(saved.with_name("again.onnx"), loaded)
    assert saved.with_name("again.onnx").read_bytes() == saved.read_bytes()


@settings(max_examples=30, deadline=None)
@given(
    features=strategies.lists(strategies.sampled_from(["albedo.R", "normal.X", "depth.Z"]), unique=True),
    pilots=strategies.lists(
        strategies.builds(
            Pilot,
            radius=strategies.integers(1, 32).map(lambda r: 2 * r),
            k=strategies.none() | strategies.floats(0.1, 10),
            step=strategies.sampled_from([1, 2]),
            with_position=strategies.booleans(),
        ),
        min_size=1,
        max_size=4,
    ),
    candidates=strategies.integers(0, 2),
    relmse=strategies.none() | strategies.floats(0, 1e9),
    seed=strategies.integers(0, 2**63 - 1),
    data=strategies.data(),
)
def test_every_model_survives_its_file(
    features: list[str],
    pilots: list[Pilot],
    candidates: int,
    relmse: float | None,
    seed: int,
    data: strategies.DataObject,
) -> None:
    reference = data.draw(strategies.integers(1, len(pilots) + candidates))
    layout = Layout(tuple(features), tuple(pilots), candidates, reference)
    planes = len(layout.planes)
    constants = Standardisation(np.linspace(-9, 9, planes), np.full(planes, 0.3, np.float32))
    fit = Model(
        "pointwise",
        layout.planes,
        first_weights(layout, seed),
        FitSettings("final", seed=seed),
        relmse,
        "0" * 64,
        layout,
        constants,
    )
    again = model_file._model_from_bytes(proto_from_model(fit).SerializeToString())
    assert_same(fit, again)


def test_a_model_is_written_whole_or_not_at_all(
    model: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=r"ends in \.onnx"):
        save_model(tmp_path / "m.pt", model)
    monkeypatch.setattr(model_file, "LARGEST_FILE_BYTES", 100)
    with pytest.raises(InputError, match="at most"):
        save_model(tmp_path / "m.onnx", model)
    weights = {**model.weights, "layer2.bias": np.zeros(3, np.float32)}
    with pytest.raises(InputError, match=r"layer2\.bias: expected shape \(16,\), found shape \(3,\)"):
        save_model(tmp_path / "m.onnx", replace(model, weights=weights))
    assert list(tmp_path.iterdir()) == []


# --- Hostile files ----------------------------------------------------------------------------------

Spoil = Callable[[onnx.ModelProto], None]


def weight(proto: onnx.ModelProto, name: str = "layer1.weight") -> TensorProto:
    return next(tensor for tensor in proto.graph.initializer if tensor.name == name)


def external(proto: onnx.ModelProto) -> None:
    tensor = weight(proto)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../../etc/passwd")


def external_beside_raw(proto: onnx.ModelProto) -> None:
    weight(proto).external_data.add(key="location", value="/etc/passwd")


def huge(proto: onnx.ModelProto) -> None:
    weight(proto).dims[0] = 1 << 40


def negative(proto: onnx.ModelProto) -> None:
    weight(proto).dims[0] = -16


def reshaped(proto: onnx.ModelProto) -> None:
    tensor = weight(proto, "layer2.weight")
    tensor.dims[:] = [256, 1, 1, 1]


def not_finite(proto: onnx.ModelProto) -> None:
    tensor = weight(proto)
    tensor.raw_data = np.float32(np.nan).tobytes() + tensor.raw_data[4:]


def doubles(proto: onnx.ModelProto) -> None:
    weight(proto).data_type = TensorProto.DOUBLE


def strings(proto: onnx.ModelProto) -> None:
    weight(proto).data_type = TensorProto.STRING


def custom_operator(proto: onnx.ModelProto) -> None:
    proto.graph.node[3].op_type = "RunShell"
    proto.graph.node[3].domain = "com.evil"


def custom_domain(proto: onnx.ModelProto) -> None:
    proto.opset_import.add(domain="com.evil", version=1)


def loop(proto: onnx.ModelProto) -> None:
    body = helper.make_graph([], "body", [], [])
    proto.graph.node.append(helper.make_node("Loop", ["", ""], [], body=body))


def branch(proto: onnx.ModelProto) -> None:
    body = helper.make_graph([helper.make_node("Identity", ["color"], ["x"])], "body", [], [])
    proto.graph.node.append(helper.make_node("If", ["color"], ["y"], then_branch=body, else_branch=body))


def function(proto: onnx.ModelProto) -> None:
    node = helper.make_node("Identity", ["a"], ["b"])
    proto.functions.append(helper.make_function("", "Clip", ["a"], ["b"], [node], proto.opset_import))


def attribute(proto: onnx.ModelProto) -> None:
    node = next(node for node in proto.graph.node if node.op_type == "LeakyRelu")
    node.attribute[0].f = 1e30


def constant(proto: onnx.ModelProto) -> None:
    tensor = next(tensor for tensor in proto.graph.initializer if tensor.name == "number 4.0")
    tensor.raw_data = np.float32(1e30).tobytes()


def unused_weight(proto: onnx.ModelProto) -> None:
    proto.graph.initializer.add(
        name="spare.weight", dims=[1], data_type=TensorProto.FLOAT, raw_data=b"\0\0\0\0"
    )


def twice(proto: onnx.ModelProto) -> None:
    proto.graph.initializer.add().CopyFrom(weight(proto))


def missing(proto: onnx.ModelProto) -> None:
    proto.graph.initializer.remove(weight(proto, "std"))


def zero_std(proto: onnx.ModelProto) -> None:
    tensor = weight(proto, "std")
    tensor.raw_data = bytes(len(tensor.raw_data))


def many_nodes(proto: onnx.ModelProto) -> None:
    for _ in range(1 << 17):
        proto.graph.node.add()


def long_name(proto: onnx.ModelProto) -> None:
    proto.graph.node[0].name = "x" * (2 << 20)


def no_metadata(proto: onnx.ModelProto) -> None:
    del proto.metadata_props[:]


def metadata(old: str, new: str) -> Spoil:
    def spoil(proto: onnx.ModelProto) -> None:
        assert old in proto.metadata_props[0].value
        proto.metadata_props[0].value = proto.metadata_props[0].value.replace(old, new, 1)

    return spoil


def whole_metadata(value: str) -> Spoil:
    def spoil(proto: onnx.ModelProto) -> None:
        proto.metadata_props[0].value = value

    return spoil


PILOT = (
    '{"along_edges": false, "by_color": false, "k": null, "radius": 1, "step": 1, "with_position": false}, '
)

HOSTILE: list[tuple[Spoil, str]] = [
    (external, "within the file"),
    (external_beside_raw, "within the file"),
    (huge, "raw data of the shape"),
    (negative, "raw data of the shape"),
    (reshaped, r"layer2\.weight: expected shape"),
    (not_finite, "NaN or Inf"),
    (doubles, r"layer1\.weight: expected f4"),
    (strings, r"layer1\.weight: expected f4"),
    (custom_operator, "RunShell"),
    (custom_domain, r"com\.evil"),
    (loop, "Loop"),
    (branch, "If"),
    (function, "functions"),
    (attribute, "constants or attributes"),
    (constant, "constants or attributes"),
    (unused_weight, r"spare\.weight"),
    (twice, "constants or attributes"),
    (missing, "std: expected a weight"),
    (zero_std, "std: expected numbers above 0"),
    (many_nodes, "too many parts"),
    (long_name, "beside the weights"),
    (no_metadata, "tungsten-dip wrote"),
    (metadata('"format": 3', '"format": 1'), "expected format 3, found 1"),
    (metadata('"kind": "pointwise"', '"kind": "skip"'), "kind|network"),
    (metadata('"candidates": 0', '"candidates": 1000000000000'), "planes|layout"),
    (metadata('"radius": 1', '"radius": 1000000000'), "radius"),
    (metadata('"step": 1', '"step": 0'), "radius"),
    (metadata('"k": 1.0', '"k": 1e-30'), "k from"),
    (metadata('"pilots": [', '"pilots": [' + 70 * PILOT), "at most 64 images"),
    (metadata('"step": 1', '"step": true'), "step"),
    (metadata('"with_position"', '"mean"'), "pilots"),
    (metadata('"preset": "draft"', '"preset": ["draft"]'), "preset"),
    (metadata('"channels": [8', '"channels": [-8'), "channels"),
    (metadata('"channels": [8', '"channels": [' + 62 * "8, " + "8"), "channels"),
    (metadata('"channels": [8', '"channels": [' + 20_000 * "8, " + "8"), "channels"),
    (metadata('"seed": 0', '"seed": NaN'), "JSON"),
    (metadata('"noise"', '"nois"'), "planes"),
    (metadata('"version": "', '"version": "1'), "constants or attributes|graph"),
    (metadata('{"', '{"extra": 1, "'), "graph"),
    (whole_metadata("[" * 100_000), "JSON"),
    (whole_metadata("{"), "JSON"),
    (whole_metadata("[]"), "format"),
    (whole_metadata('{"format": 3}'), "kind"),
]


@pytest.mark.parametrize(("spoil", "message"), HOSTILE, ids=range(len(HOSTILE)))
def test_a_spoilt_file_is_refused_in_one_line(
    spoil: Spoil, message: str, saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ort, "InferenceSession", None)
    proto = onnx.load(saved)
    spoil(proto)
    saved.write_bytes(proto.SerializeToString())
    with pytest.raises(InputError, match=message) as raised:
        load_model(saved)
    text = str(raised.value)
    assert text.startswith(f"{saved}: ")
    assert "\n" not in text
    assert len(text) < 500


def test_files_that_are_no_models(tmp_path: Path, saved: Path) -> None:
    cases = {
        "empty": b"",
        "zeros": bytes(5000),
        "noise": np.random.default_rng(0).bytes(5000),
        "endless number": b"\xff" * 100,
        "long part": b"\x3a\xff\xff\xff\xff\xff\xff\xff\x7f",
        "many numbers": b"\x08\x01" * (1 << 18),
        "nested": b"\x3a\x7e" * 64,
        "pickle": b"\x80\x04cos\nsystem\n(S'true'\ntR.",
    }
    for name, content in cases.items():
        path = tmp_path / f"{name}.onnx"
        path.write_bytes(content)
        with pytest.raises(InputError) as raised:
            load_model(path)
        assert str(path) in str(raised.value)
    with pytest.raises(InputError, match=r"none\.onnx: cannot be read"):
        load_model(tmp_path / "none.onnx")
    with pytest.raises(InputError, match="expected a file"):
        load_model(tmp_path)


@pytest.mark.parametrize("name", [b"layer1.weight", b"tungsten_dip", b"Conv", b"inputs"])
def test_names_that_are_no_text_are_refused(name: bytes, saved: Path) -> None:
    content = saved.read_bytes()
    assert name in content
    saved.write_bytes(content.replace(name, b"\xff" + name[1:]))
    with pytest.raises(InputError):
        load_model(saved)


def test_nested_graphs_do_not_exhaust_the_stack(model: Model, tmp_path: Path) -> None:
    content = b""
    for _ in range(5000):  # attribute { g: graph { node { attribute ...
        for key in (b"\x2a", b"\x0a", b"\x32"):
            size = len(content)
            length = b""
            while True:
                size, low = size >> 7, size & 0x7F
                length += bytes([low | (0x80 if size else 0)])
                if not size:
                    break
            content = key + length + content
    proto = proto_from_model(model)
    tail = b"\x3a" + _varint(len(content)) + content
    (tmp_path / "m.onnx").write_bytes(proto.SerializeToString() + tail)
    with pytest.raises(InputError):
        load_model(tmp_path / "m.onnx")


def _varint(value: int) -> bytes:
    encoded = b""
    while value > 0x7F:
        encoded += bytes([value & 0x7F | 0x80])
        value >>= 7
    return encoded + bytes([value])


def test_a_file_too_large_is_not_read(saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sparse = tmp_path / "large.onnx"
    with sparse.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match=r"at most 64\.0 MiB"):
        load_model(sparse)


@settings(max_examples=60, deadline=None)
@given(data=strategies.data())
def test_bytes_changed_anywhere_are_refused_or_make_another_model(
    data: strategies.DataObject, model: Model
) -> None:
    content = bytearray(proto_from_model(model).SerializeToString())
    cut = data.draw(strategies.integers(0, len(content)))
    if data.draw(strategies.booleans()):
        content = content[:cut]
    for _ in range(data.draw(strategies.integers(0, 3))):
        if content:
            content[data.draw(strategies.integers(0, len(content) - 1))] = data.draw(
                strategies.integers(0, 255)
            )
    try:
        loaded = model_file._model_from_bytes(bytes(content))
    except InputError:
        return
    # What gets through is what we would have written ourselves.
    proto = onnx.ModelProto()
    proto.ParseFromString(bytes(content))
    assert proto_from_model(loaded) == proto


# --- Warm starts ------------------------------------------------------------------------------------


def test_a_warm_start_starts_from_the_weights_and_constants(
    model: Model, fitted: FitResult, next_frame: SyntheticRender, frame: SyntheticRender
) -> None:
    again = denoise(frame.buffers, replace(DRAFT, iterations=1), warm_start=model)
    assert again.iterations == 1
    assert again.history[0].iteration == 0
    assert again.model is not None
    for name, value in model.weights.items():
        np.testing.assert_allclose(again.model.weights[name], value, atol=5e-4)
    np.testing.assert_allclose(again.color, fitted.color, rtol=0.02)

    other = denoise(next_frame.buffers, replace(DRAFT, iterations=1), warm_start=model)
    assert other.model is not None
    assert model.standardisation is not None
    assert other.model.standardisation is not None
    np.testing.assert_array_equal(other.model.standardisation.mean, model.standardisation.mean)
    assert other.model.layout == model.layout
    assert other.model.source_sha256 != model.source_sha256


def test_a_warm_start_ends_when_the_error_falls_no_further(
    frame: SyntheticRender, next_frame: SyntheticRender
) -> None:
    def relmse(result: FitResult) -> float:
        truth = next_frame.reference
        return float(np.mean((result.color - truth) ** 2 / (truth**2 + 0.01)))

    long = replace(DRAFT, iterations=150)
    trained = denoise(frame.buffers, long).model
    cold = denoise(next_frame.buffers, long)
    warm = denoise(next_frame.buffers, replace(DRAFT, iterations=150), warm_start=trained)
    assert warm.iterations < 100
    assert any("falls no further" in note for note in warm.notes)
    assert relmse(warm) < 1.25 * relmse(cold)
    # Without settings, those of the model hold.
    assert denoise(next_frame.buffers, warm_start=trained).settings.preset == "draft"


@pytest.mark.parametrize("by", ["torch", "onnxruntime"])
def test_a_network_is_fitted_anew_to_an_image_unlike_the_models(
    by: str, model: Model, frame: SyntheticRender
) -> None:
    albedo = frame.buffers.albedo
    assert albedo is not None
    light = Buffer(*(20 * plane for _, plane in albedo.planes()))
    unlike = frame.buffers.with_quantities(albedo=light)
    if by == "torch":
        result = denoise(unlike, replace(DRAFT, iterations=20), warm_start=model)
        # Only which pilot the others are compared with is the model's own.
        cold = denoise(unlike, replace(DRAFT, iterations=20))
        np.testing.assert_allclose(result.color, cold.color, rtol=1e-3, atol=1e-4)
    else:
        result = infer(model, unlike, threads=1, refit_steps=20)
    assert "the model knows no such images: a network is fitted anew" in result.notes
    assert result.iterations == 20
    assert result.model is not None
    assert result.model.standardisation is not None
    assert model.standardisation is not None
    assert not np.array_equal(result.model.standardisation.mean, model.standardisation.mean)
    # What is written is a model that can be used.
    assert np.isfinite(infer(result.model, unlike, threads=1).color).all()


def test_a_paper_network_starts_from_the_weights(frame: SyntheticRender) -> None:
    fit = paper_model("resnet", frame.buffers)
    again = denoise(frame.buffers, replace(fit.settings, iterations=1), warm_start=fit)
    assert again.model is not None
    for name, value in fit.weights.items():
        np.testing.assert_allclose(again.model.weights[name], value, atol=3e-3)


def test_a_model_that_does_not_fit_is_refused_with_the_difference_named(
    model: Model, frame: SyntheticRender
) -> None:
    buffers = frame.buffers
    without = buffers.with_quantities(normal=None)
    for use in (lambda b: infer(model, b), lambda b: denoise(b, DRAFT, warm_start=model)):
        with pytest.raises(InputError, match=r"fitted with normal\.X, normal\.Y, normal\.Z, which"):
            use(without)
    with pytest.raises(InputError, match="fitted with preset draft, this fit asks for balanced"):
        denoise(buffers, replace(DRAFT, preset="balanced"), warm_start=model)
    with pytest.raises(InputError, match="fitted with 0 candidates, this input comes with 1"):
        denoise(buffers, DRAFT, candidates=[(frame.reference, frame.reference)], warm_start=model)

    paper = paper_model("skip", buffers)
    with pytest.raises(InputError, match="fitted with preset paper, this fit asks for draft"):
        denoise(buffers, DRAFT, warm_start=paper)
    with pytest.raises(InputError, match="network skip, this fit asks for resnet"):
        denoise(buffers, replace(paper.settings, network="resnet"), warm_start=paper)
    with pytest.raises(InputError, match="channels 4,6,8, this fit asks for 4,6"):
        denoise(buffers, replace(paper.settings, channels=(4, 6)), warm_start=paper)
    with pytest.raises(InputError, match=r"lacks normal mean 0"):
        infer(paper, without)


# --- Training as a graph ----------------------------------------------------------------------------


def examples_for_training(seed: int = 0) -> tuple[Examples, Layout]:
    evidence = evidence_of(synthetic_render(24, 20, seed=seed).buffers, (Pilot(1), Pilot(3)))
    return start_of_training(evidence, seed).examples, evidence.layout


@pytest.mark.parametrize("pixels", [1, 37, 480])
def test_gradients_and_updates_agree_with_torch(pixels: int) -> None:
    examples, layout = examples_for_training()
    weights = first_weights(layout, seed=3)
    rng = np.random.default_rng(4)
    for name, value in weights.items():
        weights[name] = value + rng.normal(0, 0.3, value.shape).astype(np.float32)
    batch = examples.at(rng.integers(2 * 480, size=pixels))

    in_torch = TorchNetwork(weights)
    in_onnx = PointwiseNetwork(weights, len(layout.planes), layout.choices)
    proto = training_step(len(layout.planes), layout.choices)
    onnx.checker.check_model(proto, full_check=True)
    vector = np.concatenate([value.ravel() for value in weights.values()])
    feeds = {
        "inputs": batch.inputs,
        "choices": batch.choices,
        "wanted": batch.wanted,
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
    squared = (in_onnx.fuse(batch) - batch.wanted) ** 2 * batch.weight
    assert loss == pytest.approx(squared.mean(), rel=1e-4)

    for _ in range(5):
        for network in (in_torch, in_onnx):
            network.step(batch, 1e-2)
    for name, value in in_torch.weights().items():
        np.testing.assert_allclose(in_onnx.weights()[name].reshape(value.shape), value, rtol=1e-4, atol=1e-4)


def test_gradients_are_those_of_the_loss() -> None:
    """Against central differences in double precision, without torch."""
    rng = np.random.default_rng(0)
    planes, choices, pixels = 3, 2, 5
    shapes = weight_shapes(planes, choices)
    vector = rng.normal(0, 0.5, sum(int(np.prod(s)) for s in shapes.values()))
    feeds = {
        "inputs": rng.normal(size=(pixels, planes)),
        "choices": rng.random((pixels, choices, 3)),
        "wanted": rng.random((pixels, 3)),
        "weight": rng.random((pixels, 1)),
    }

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
        fused = (shares[:, :, None] * feeds["choices"]).sum(1)
        return float(np.mean(feeds["weight"] * (fused - feeds["wanted"]) ** 2))

    expected = [(loss(vector + d) - loss(vector - d)) / 2e-6 for d in 1e-6 * np.eye(vector.size)]
    zeros = np.zeros(vector.size, np.float32)
    single = {name: value.astype(np.float32) for name, value in {**feeds, "weights": vector}.items()}
    one = np.ones(1, np.float32)
    state = {"mean": zeros, "square": zeros, "learning_rate": one, "step": one}
    gradient = session_from_proto(training_step(planes, choices), 1).run(["gradient"], {**single, **state})[0]
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


def test_evidence_in_bands_is_that_of_the_whole(frame: SyntheticRender) -> None:
    evidence = evidence_of(frame.buffers, (Pilot(1), Pilot(3)))
    whole = network_inputs(evidence).reshape(2, 32, 48, -1)
    upper = network_inputs(evidence.rows(0, 28)).reshape(2, 28, 48, -1)
    lower = network_inputs(evidence.rows(4, 32)).reshape(2, 28, 48, -1)
    inner = 28 - PLANES_RADIUS
    np.testing.assert_allclose(upper[:, :inner], whole[:, :inner], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(lower[:, -inner:], whole[:, -inner:], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("changed", ["seen", "scoring"])
def test_the_network_sees_the_noise_of_no_pixel_at_that_pixel(changed: str, frame: SyntheticRender) -> None:
    # Neither the half's own, which it would choose for being dark, nor the other's, which it is scored by.
    evidence = evidence_of(frame.buffers, (Pilot(1), Pilot(3)))
    y, x, half = 11, 17, 0
    noisy = [image.copy() for image in evidence.halves]
    noisy[half if changed == "seen" else 1 - half][y, x] *= 3
    other = replace(evidence, pilots=((noisy[0], noisy[1]), *evidence.pilots[1:]))
    before, after = (np.stack(list(planes_of_half(e, half)), axis=2) for e in (evidence, other))
    np.testing.assert_allclose(after[y, x], before[y, x], rtol=1e-3, atol=1e-3)
    assert np.abs(after - before).max() > 0.01


# --- Without torch, and as commands -----------------------------------------------------------------

WITHOUT_EXTRAS = """
import sys
for name in ('torch', 'mitsuba', 'skimage', 'flip_evaluator'):
    sys.modules[name] = None  # to import it is an error
from tungsten_dip.cli.tungsten_dip import main
sys.exit(main(sys.argv[1:]))
"""


def test_the_commands_of_the_base_installation_do_without_torch(
    saved: Path, tmp_path: Path, frame: SyntheticRender, next_frame: SyntheticRender
) -> None:
    write_tungsten_folder(tmp_path / "in", next_frame.buffers)

    def run(*arguments: Any) -> str:
        program = [sys.executable, "-c", WITHOUT_EXTRAS, *map(str, arguments)]
        done = subprocess.run(program, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    run("inspect", tmp_path / "in")
    refined = tmp_path / "refined.onnx"
    out = tmp_path / "out.exr"
    told = run(
        "infer", saved, tmp_path / "in", "-o", out, "--refit", 5, "--threads", 1, "--save-model", refined
    )
    assert "5 iterations" in told
    assert out.exists()
    assert load_model(refined).layout == load_model(saved).layout
    run("infer", refined, tmp_path / "in", "-o", tmp_path / "again.exr", "--error-map", tmp_path / "e.exr")
    assert "psnr" in run("compare", out, tmp_path / "again.exr").lower()


def test_save_and_warm_start_on_the_command_line(
    tmp_path: Path, frame: SyntheticRender, capfd: pytest.CaptureFixture[str]
) -> None:
    write_tungsten_folder(tmp_path / "in", frame.buffers)
    fit = ["denoise", str(tmp_path / "in"), "-o", str(tmp_path / "out.exr"), "--threads", "1"]
    first, second = str(tmp_path / "1.onnx"), str(tmp_path / "2.onnx")
    assert command.main([*fit, "--preset", "draft", "--iterations", "5", "--save-model", first]) == 0
    # The preset is the model's.
    assert command.main([*fit, "--iterations", "3", "--warm-start", first, "--save-model", second]) == 0
    assert load_model(second).settings.preset == "draft"
    assert load_model(second).settings.iterations == 3
    capfd.readouterr()
    assert command.main([*fit, "--preset", "final", "--warm-start", first]) == 2
    assert "fitted with preset draft, this fit asks for final" in capfd.readouterr().err
    assert command.main([*fit, "--warm-start", str(tmp_path / "in" / "color.exr")]) == 2
    assert command.main([*fit, "--save-model", str(tmp_path / "m.pt")]) == 2
    truth = frame.reference
    color = Buffer(truth, truth * np.float32(0.9999), truth * np.float32(1.0001))
    write_tungsten_folder(tmp_path / "clean", frame.buffers.with_quantities(color=color))
    capfd.readouterr()
    clean = ["denoise", str(tmp_path / "clean"), "-o", str(tmp_path / "clean.exr"), "--threads", "1"]
    assert command.main([*clean, "--save-model", str(tmp_path / "none.onnx")]) == 2
    assert "no network was fitted" in capfd.readouterr().err
    assert not (tmp_path / "none.onnx").exists()


def test_onnxruntime_keeps_no_telemetry(tmp_path: Path) -> None:
    program = (
        "from tungsten_dip.fit.pointwise import training_step\n"
        "from tungsten_dip.graphs.sessions import session_from_proto\n"
        "session_from_proto(training_step(2, 2), 1)"
    )
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "ORT_"))}
    subprocess.run([sys.executable, "-c", program], env={**kept, "HOME": str(tmp_path)}, check=True)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
