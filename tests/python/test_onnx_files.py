"""Models as files: what is saved is read again."""

from __future__ import annotations

import itertools
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies

from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitSettings
from tungsten_dip.fit.layout import Layout, Pilot
from tungsten_dip.fit.model import Blend, Model
from tungsten_dip.fit.network.blend_network import first_weights
from tungsten_dip.fit.presets import RECIPES, recipe_of
from tungsten_dip.fit.standardisation import Standardisation
from tungsten_dip.onnx import file as model_file
from tungsten_dip.onnx import load_model, save_model
from tungsten_dip.onnx.file import proto_from_model

PILOTS = sorted(
    {
        pilot
        for preset, following in itertools.product(RECIPES, (False, True))
        for pilot in recipe_of(FitSettings(preset), following=following).pilots
    },
    key=repr,
)


def assert_same(first: Model, second: Model) -> None:
    for name, value in asdict(first).items():
        if name in ("weights", "blend", "settings"):
            continue
        assert asdict(second)[name] == value
    assert first.weights.keys() == second.weights.keys()
    for name, weight in first.weights.items():
        np.testing.assert_array_equal(second.weights[name], weight)
    assert second.is_paper == first.is_paper
    if first.blend is not None:
        assert second.blend is not None
        assert second.blend.layout == first.blend.layout
        before, after = first.blend.standardisation, second.blend.standardisation
        np.testing.assert_array_equal(after.mean, before.mean)
        np.testing.assert_array_equal(after.std, before.std)


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
    pilots=strategies.lists(strategies.sampled_from(PILOTS), min_size=1, unique=True),
    extra_count=strategies.integers(0, 2),
    relmse=strategies.none() | strategies.floats(0, 1e9),
    seed=strategies.integers(0, 2**63 - 1),
    members=strategies.integers(1, 16),
    data=strategies.data(),
)
def test_every_model_survives_its_file(
    features: list[str],
    pilots: list[Pilot],
    extra_count: int,
    relmse: float | None,
    seed: int,
    members: int,
    data: strategies.DataObject,
) -> None:
    baseline = data.draw(strategies.integers(1, len(pilots) + extra_count))
    layout = Layout(tuple(features), tuple(pilots), extra_count, baseline)
    inputs = len(layout.inputs)
    constants = Standardisation(np.linspace(-9, 9, inputs), np.full(inputs, 0.3, np.float32))
    fit = Model(
        layout.inputs,
        first_weights(layout, seed, members),
        FitSettings("final", seed=seed),
        relmse,
        "0" * 64,
        Blend(layout, constants),
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
    weights = {**model.weights, "layer1.bias": np.zeros(17 * 16, np.float32)}
    with pytest.raises(InputError, match="17 members: expected at most 16"):
        save_model(tmp_path / "m.onnx", replace(model, weights=weights))
    assert list(tmp_path.iterdir()) == []
