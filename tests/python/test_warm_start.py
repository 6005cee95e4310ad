"""Networks that start from those of another image, and the commands that save and load them."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fitted_models import DRAFT, paper_model
from synthetic import SyntheticRender, relmse
from tungsten_dip.buffers.render_buffers import Buffer
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.cli import tungsten_dip as command
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitResult, denoise
from tungsten_dip.fit.blending import fit_blend
from tungsten_dip.fit.model import Model
from tungsten_dip.fit.network import training
from tungsten_dip.onnx import infer, load_model, save_model
from tungsten_dip.progress import silent


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
    assert model.blend is not None
    assert other.model.blend is not None
    np.testing.assert_array_equal(other.model.blend.standardisation.mean, model.blend.standardisation.mean)
    assert other.model.blend.layout == model.blend.layout
    assert other.model.source_sha256 != model.source_sha256


def test_a_warm_start_ends_when_the_error_falls_no_further(
    frame: SyntheticRender, next_frame: SyntheticRender
) -> None:
    long = replace(DRAFT, iterations=150)
    trained = denoise(frame.buffers, long).model
    cold = denoise(next_frame.buffers, long)
    warm = denoise(next_frame.buffers, replace(DRAFT, iterations=150), warm_start=trained)
    assert warm.iterations < 100
    assert any("falls no further" in note for note in warm.notes)
    error, cold_error = (relmse(result.color, next_frame.reference) for result in (warm, cold))
    assert error < 1.25 * cold_error
    # Without settings, those of the model hold.
    assert denoise(next_frame.buffers, warm_start=trained).settings.preset == "draft"


def test_a_warm_start_from_memory_is_one_from_the_saved_file(
    frame: SyntheticRender, next_frame: SyntheticRender, tmp_path: Path
) -> None:
    settings = replace(DRAFT, iterations=20, time_budget_s=1e9, target_error=10.0, device="cpu")
    model = denoise(frame.buffers, settings).model
    assert model is not None
    save_model(tmp_path / "m.onnx", model)
    loaded = load_model(tmp_path / "m.onnx")
    assert model.settings == loaded.settings
    results = [denoise(next_frame.buffers, warm_start=each) for each in (model, loaded)]
    assert results[0].settings == results[1].settings
    assert results[0].iterations == results[1].iterations > 1
    np.testing.assert_array_equal(results[0].color, results[1].color)


def test_a_warm_start_that_only_gets_worse_leaves_the_weights_as_they_were(
    model: Model, next_frame: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = itertools.count(1.0)
    monkeypatch.setattr(training, "held_out_error", lambda *_: next(errors))
    again = denoise(next_frame.buffers, replace(DRAFT, iterations=50), warm_start=model)
    assert again.iterations == 15  # after estimates at 5, 10 and 15
    assert again.model is not None
    for name, value in model.weights.items():
        np.testing.assert_array_equal(again.model.weights[name], value)


@pytest.mark.parametrize("by", ["denoise", "infer"])
def test_a_network_is_fitted_anew_to_an_image_unlike_the_models(
    by: str, model: Model, frame: SyntheticRender
) -> None:
    """All of it is a lamp."""
    color, albedo = frame.buffers.color, frame.buffers.albedo
    assert albedo is not None
    light = Buffer(*(20 * plane for _, plane in albedo.planes()))
    lit = Buffer(*(a + b for (_, a), (_, b) in zip(color.planes(), light.planes(), strict=True)))
    unlike = frame.buffers.with_quantities(color=lit, albedo=light)
    if by == "denoise":
        result = denoise(unlike, replace(DRAFT, iterations=20), warm_start=model)
        # Only which pilot the others are compared with is the model's own.
        cold = denoise(unlike, replace(DRAFT, iterations=20))
        np.testing.assert_allclose(result.color, cold.color, rtol=1e-3, atol=1e-4)
    else:
        result = infer(model, unlike, threads=1, refit_steps=3)
    assert "the image is too unlike the model's: a new network is fitted" in result.notes
    # A refit limits how long a network is trained further; a new one of preset draft takes 80 steps.
    assert result.iterations == {"denoise": 20, "infer": 80}[by]
    assert result.model is not None
    assert result.model.blend is not None
    assert model.blend is not None
    assert not np.array_equal(result.model.blend.standardisation.mean, model.blend.standardisation.mean)
    # What is written is a model that can be used.
    assert np.isfinite(infer(result.model, unlike, threads=1).color).all()


def test_a_paper_network_starts_from_the_weights(frame: SyntheticRender) -> None:
    fit = paper_model("resnet", frame.buffers)
    again = denoise(frame.buffers, replace(fit.settings, iterations=1), warm_start=fit)
    assert again.model is not None
    for name, value in fit.weights.items():
        np.testing.assert_allclose(again.model.weights[name], value, atol=3e-3)


def test_a_paper_network_whose_weights_overflow_is_refused(frame: SyntheticRender) -> None:
    fit = paper_model("resnet", frame.buffers)
    huge = replace(fit, weights={name: np.full_like(value, 1e38) for name, value in fit.weights.items()})
    with pytest.raises(InputError, match="its weights are too large; fit a new one"):
        denoise(frame.buffers, replace(fit.settings, iterations=3), warm_start=huge)


def test_a_model_that_does_not_fit_is_refused_with_the_difference_named(
    model: Model, frame: SyntheticRender
) -> None:
    buffers = frame.buffers
    without = buffers.with_quantities(normal=None)
    for use in (lambda b: infer(model, b), lambda b: denoise(b, DRAFT, warm_start=model)):
        with pytest.raises(InputError, match=r"fitted with normal\.X, normal\.Y, normal\.Z, which"):
            use(without)
    with pytest.raises(InputError, match="fitted with preset draft, this fit is to use balanced"):
        denoise(buffers, replace(DRAFT, preset="balanced"), warm_start=model)
    with pytest.raises(InputError, match=r"fitted with 0 extra pilots .*, this input comes with 1"):
        fit_blend(buffers, DRAFT, silent, model, previous=(frame.reference, frame.reference))

    paper = paper_model("skip", buffers)
    with pytest.raises(InputError, match="fitted with preset paper, this fit is to use draft"):
        denoise(buffers, DRAFT, warm_start=paper)
    with pytest.raises(InputError, match="network skip, this fit is to use resnet"):
        denoise(buffers, replace(paper.settings, network="resnet"), warm_start=paper)
    with pytest.raises(InputError, match="channels 4,6,8, this fit is to use 4,6"):
        denoise(buffers, replace(paper.settings, channels=(4, 6)), warm_start=paper)
    with pytest.raises(InputError, match=r"lacks normal mean 0"):
        infer(paper, without)


def test_features_that_a_model_does_not_know_are_named(model: Model, frame: SyntheticRender) -> None:
    note = "the model was fitted without albedo, normal: its network does not use it"
    few = denoise(frame.buffers.with_quantities(albedo=None, normal=None), DRAFT).model
    assert few is not None
    assert note in infer(few, frame.buffers).notes
    assert not [line for line in infer(model, frame.buffers).notes if "fitted without" in line]


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
    assert load_model(refined).blend.layout == load_model(saved).blend.layout
    run("infer", refined, tmp_path / "in", "-o", tmp_path / "again.exr", "--error-map", tmp_path / "e.exr")
    assert "psnr" in run("compare", out, tmp_path / "again.exr").lower()


@pytest.mark.parametrize(
    ("option", "value", "told"), [("--refit", "-1", "refit_steps: "), ("--threads", "0", "threads: ")]
)
def test_numbers_that_infer_cannot_take_are_told_before_anything_is_read(
    option: str, value: str, told: str, saved: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = ["infer", str(saved), "missing", "-o", str(saved.parent / "out.exr"), option, value]
    assert command.main(arguments) == 2
    assert f"tungsten-dip: {told}expected" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "installed", "told"),
    [
        (["denoise", "--warm-start", "{plain}", "--pilot", "oidn"], True, "fitted with pilot none"),
        (["denoise", "--pilot", "oidn"], False, "needs pyoidn"),
        (["infer", "{oidn}"], False, "needs pyoidn"),
        (["infer", "{paper}", "--refit", "5"], True, "expected 0 steps of a network of preset paper"),
        (["infer", "{plain}", "--save-model", "q.onnx"], True, "--save-model: without --refit"),
    ],
)
def test_what_needs_no_input_is_checked_before_it_is_read(
    arguments: list[str],
    installed: bool,
    told: str,
    model: Model,
    frame: SyntheticRender,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    models = {
        "plain": model,
        "oidn": replace(model, settings=replace(model.settings, pilot="oidn")),
        "paper": paper_model("resnet", frame.buffers),
    }
    paths = {name: tmp_path / f"{name}.onnx" for name in models}
    for name, each in models.items():
        save_model(paths[name], each)
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: object() if installed else None)
    words = [word.format(**paths) for word in arguments]
    assert command.main([*words, "missing", "-o", str(tmp_path / "out.exr")]) == 2
    assert told in capfd.readouterr().err


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
    assert "fitted with preset draft, this fit is to use final" in capfd.readouterr().err
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


def test_an_error_that_cannot_be_known_is_refused_before_the_work(
    tmp_path: Path, frame: SyntheticRender, capfd: pytest.CaptureFixture[str]
) -> None:
    save_model(tmp_path / "paper.onnx", paper_model("resnet", frame.buffers))
    write_tungsten_folder(tmp_path / "in", frame.buffers)
    rest = [str(tmp_path / "in"), "-o", str(tmp_path / "out.exr"), "--error-map", str(tmp_path / "e.exr")]
    for first in (["denoise", "--preset", "paper"], ["infer", str(tmp_path / "paper.onnx")]):
        assert command.main([*first, *rest]) == 2
        assert "--error-map: the published method estimates no error" in capfd.readouterr().err
    assert not (tmp_path / "out.exr").exists()


def test_another_preset_than_the_models_is_named(
    tmp_path: Path, frame: SyntheticRender, capfd: pytest.CaptureFixture[str]
) -> None:
    save_model(tmp_path / "paper.onnx", paper_model("resnet", frame.buffers))
    write_tungsten_folder(tmp_path / "in", frame.buffers)
    fit = ["denoise", str(tmp_path / "in"), "-o", str(tmp_path / "out.exr"), "--preset", "draft"]
    assert command.main([*fit, "--warm-start", str(tmp_path / "paper.onnx")]) == 2
    assert "fitted with preset paper, this fit is to use draft" in capfd.readouterr().err


def test_onnxruntime_keeps_no_telemetry(tmp_path: Path) -> None:
    program = (
        "from tungsten_dip.fit.network.blend_network import training_step\n"
        "from tungsten_dip.graphs.sessions import session_from_proto\n"
        "session_from_proto(training_step(2, 2), 1)"
    )
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "ORT_"))}
    subprocess.run([sys.executable, "-c", program], env={**kept, "HOME": str(tmp_path)}, check=True)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
