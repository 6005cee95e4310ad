"""The command ``tungsten-dip``: what it writes, prints and refuses."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO
import pytest

import tungsten_dip
from commands import MAIN, fails
from tungsten_dip.buffers.image_file import write_exr, write_image
from tungsten_dip.buffers.read import read_image
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.buffers.source import Part
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.cli import tungsten
from tungsten_dip.cli import tungsten_dip as command
from tungsten_dip.fit.settings import FitSettings


def test_denoise_writes_every_file_asked_for(folder, tmp_path, fits, render, capfd):
    out, error, report = tmp_path / "out.exr", tmp_path / "error.exr", tmp_path / "report.html"
    arguments = ["denoise", folder, "-o", out, "--error-map", error, "--report", report]
    assert command.main(list(map(str, arguments))) == 0
    mean = render.buffers.color.mean.mean((0, 1))
    np.testing.assert_allclose(read_image(out), np.broadcast_to(mean, (40, 56, 3)), rtol=1e-6)
    np.testing.assert_array_equal(read_image(error), np.full((40, 56, 3), 0.25, np.float32))
    assert "estimated relMSE" in report.read_text()


def test_a_report_on_the_working_directory_has_its_name(folder, tmp_path, fits, monkeypatch):
    monkeypatch.chdir(folder)
    assert command.main(["denoise", ".", "-o", "../out.exr", "--report", "../page.html"]) == 0
    assert "<title>buffers" in (tmp_path / "page.html").read_text()


def test_the_error_map_lies_where_the_picture_lies(tmp_path, render, fits):
    color = render.buffers.color
    layers = {
        f"{layer}{component}": plane[..., index]
        for layer, plane in (("", color.mean), ("colorA.", color.half_a), ("colorB.", color.half_b))
        for index, component in enumerate("RGB")
    }
    height, width = layers["R"].shape
    frame = {"dataWindow": ((-16, -8), (width - 17, height - 9)), "displayWindow": ((0, 0), (95, 55))}
    write_exr(tmp_path / "in.exr", [Part(layers, frame)])
    paths = {name: str(tmp_path / f"{name}.exr") for name in ("in", "out", "error")}
    assert command.main(["denoise", paths["in"], "-o", paths["out"], "--error-map", paths["error"]]) == 0
    for name in ("out", "error"):
        header = OpenEXR.File(paths[name], header_only=True).parts[0].header
        for window, corners in frame.items():
            assert np.array_equal(header[window], corners)


def test_json_is_all_there_is_on_stdout(folder, tmp_path, fits, capfd):
    assert command.main(["denoise", str(folder), "-o", str(tmp_path / "out.exr"), "--json"]) == 0
    out, err = capfd.readouterr()
    facts = json.loads(out)
    assert facts["iterations"] == 7
    assert facts["history"][0] == {"seconds": 0.5, "iteration": 3, "estimated_relmse": 0.5}
    assert "chatters" in err


@pytest.mark.parametrize(("preset", "bytes_per_pixel"), [("draft", 550), ("balanced", 1100), ("final", 1300)])
def test_too_little_memory_is_told_before_the_fit(
    folder, tmp_path, fits, capfd, monkeypatch, preset, bytes_per_pixel
):
    arguments = ["denoise", str(folder), "-o", str(tmp_path / "out.exr"), "--preset", preset]
    warning = f"{folder}: there may be too little memory for 56 x 40 pixels"
    for pixels, told in ((56 * 40, False), (56 * 40 - 1, True)):
        available = pixels * bytes_per_pixel
        monkeypatch.setattr("tungsten_dip.hosts.memory._available_bytes", lambda free=available: free)
        assert command.main(arguments) == 0
        err = capfd.readouterr().err
        assert (warning in err) == (f"expected {pixels} at most" in err) == told
        assert ("use --preset draft" in err) == (told and preset != "draft")


def test_options_become_settings(folder, tmp_path, fits):
    given = (
        "--preset paper --iterations 12 --time-budget 1.5m --target-error 0.01 --seed 3 --device cpu "
        "--threads 1 --network resnet --inputs normals --scheme ioc --channels 4,8"
    )
    assert command.main(["denoise", str(folder), "-o", str(tmp_path / "out.exr"), *given.split()]) == 0
    assert fits == [FitSettings("paper", 12, 90.0, 0.01, "resnet", "normals", "ioc", (4, 8), 3, "cpu", 1)]


def test_denoise_again_from_its_own_output(folder, tmp_path, fits, capfd):
    first, second = str(tmp_path / "first.exr"), str(tmp_path / "second.exr")
    assert command.main(["denoise", str(folder), "-o", first]) == 0
    assert command.main(["denoise", first, "-o", second]) == 0
    np.testing.assert_array_equal(read_image(tmp_path / "first.exr"), read_image(tmp_path / "second.exr"))


def test_half_floats(folder, tmp_path, fits):
    assert command.main(["denoise", str(folder), "-o", str(tmp_path / "out.exr"), "--half"]) == 0
    spec = OpenImageIO.ImageInput.open(str(tmp_path / "out.exr")).spec()
    assert str(spec.channelformat(spec.channelindex("R"))) == "half"


def test_values_that_are_not_finite_are_mended_before_the_fit(tmp_path, render, capfd):
    color = render.buffers.color.mean.copy()
    color[3, 4] = np.nan
    write_tungsten_folder(tmp_path / "buffers", RenderBuffers(Buffer(color)))
    arguments = ["denoise", str(tmp_path / "buffers"), "-o", str(tmp_path / "out.exr"), "--preset", "draft"]
    assert command.main(arguments) == 0
    assert np.isfinite(read_image(tmp_path / "out.exr")).all()
    assert "3 NaN" in capfd.readouterr().err


def truncated(folder):
    path = folder / "color.exr"
    path.write_bytes(path.read_bytes()[:-500])
    return path


def of_another_size(folder):
    write_image(folder / "normal.exr", np.zeros((3, 4, 3), np.float32))
    return folder


def without_color(folder):
    for path in folder.glob("color*.exr"):
        path.unlink()
    return folder


def emptied(folder):
    for path in folder.iterdir():
        path.unlink()
    return folder


def without_bytes(folder):
    path = folder / "normalA.exr"
    path.write_bytes(b"")
    return path


@pytest.mark.parametrize("spoil", [truncated, of_another_size, without_color, emptied, without_bytes])
def test_bad_buffers(spoil, folder, tmp_path, fits, capfd):
    culprit = spoil(folder)
    out = tmp_path / "out.exr"
    fails(capfd, command.main(["denoise", str(folder), "-o", str(out)]), culprit)
    assert not out.exists()
    assert not fits


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("{folder}x -o {tmp}/out.exr", ["{folder}x", "no such file"]),
        ("{tmp}/picture.png -o {tmp}/out.exr", ["{tmp}/picture.png", ".exr"]),
        ("{tmp}/scene.json -o {tmp}/out.exr", ["{tmp}/scene.json", "n.exr", "render the scene first"]),
        ("{folder} -o {tmp}/none/out.exr", ["{tmp}/none/out.exr", "cannot be written"]),
        ("{folder} -o {tmp}", ["{tmp}"]),
        ("{folder} -o {tmp}/folder.exr", ["{tmp}/folder.exr", "this is a folder"]),
        ("{folder} -o {tmp}/out.png", ["{tmp}/out.png", ".exr"]),
        ("{folder} -o {tmp}/out.exr --report {tmp}/none/r.html", ["{tmp}/none/r.html"]),
        ("{folder} -o {tmp}/out.exr --error-map {tmp}/none/e.exr", ["{tmp}/none/e.exr"]),
        ("{folder} -o {tmp}/out.exr --time-budget soon", ["--time-budget", "90s", "soon"]),
        ("{folder} -o {tmp}/out.exr --error-map {tmp}/out.exr", ["{tmp}/out.exr", "two files"]),
        ("{folder} -o {tmp}/out.exr --time-budget 0", ["--time-budget", "number above 0"]),
        ("{folder} -o {tmp}/out.exr --time-budget=-5s", ["--time-budget", "90s", "-5s"]),
        ("{folder} -o {tmp}/out.exr --iterations -1", ["iterations"]),
        ("{folder} -o {tmp}/out.exr --target-error nan", ["--target-error", "number above 0"]),
        ("{folder} -o {tmp}/out.exr --network resnet", ["network", "preset paper"]),
        ("{folder} -o {tmp}/out.exr --preset paper --channels 8,x", ["--channels", "integers such as"]),
        ("{folder} -o {tmp}/out.exr --map color", ["--map", "NAME=CHANNEL"]),
        ("{folder} -o {tmp}/out.exr --map beauty=x", ["beauty"]),
        ("{folder} -o {tmp}/out.exr --map depth=z --map depth=none", ["--map depth", "z and none"]),
        ("{folder} -o {tmp}/out.exr --map color=main", ["color=main", "{folder}", "colorA.exr"]),
        ("{folder}/color.exr -o {tmp}/out.exr --map normal=N", ["normal=N", "color.exr", "R, G, B"]),
        ("{folder} -o {tmp}/out.exr --prese draft", ["--prese"]),
        ("{folder}", ["-o/--output"]),
        ("", ["INPUT"]),
    ],
)
def test_bad_arguments(arguments, words, folder, scene, tmp_path, fits, capfd):
    (tmp_path / "folder.exr").mkdir()
    write_image(tmp_path / "picture.png", np.zeros((2, 3, 3)))
    places = {"folder": folder, "tmp": tmp_path}
    before = sorted(tmp_path.rglob("*"))
    status = command.main(["denoise", *arguments.format(**places).split()])
    fails(capfd, status, *(word.format(**places) for word in words))
    assert sorted(tmp_path.rglob("*")) == before
    assert not fits


def test_no_command_is_an_error(capfd):
    fails(capfd, command.main([]), "COMMAND")


def test_inspect_a_scene(scene, capfd):
    assert command.main(["inspect", str(scene), "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    assert (facts["width"], facts["height"]) == (17, 9)
    assert command.main(["inspect", str(scene)]) == 0
    assert "depth of field" in capfd.readouterr().out


def test_inspect_buffers(folder, capfd):
    assert command.main(["inspect", str(folder), "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    assert (facts["width"], facts["height"], facts["spp"]) == (56, 40, 16)
    assert facts["quantities"]["color"] == {
        "planes": ["mean", "half_a", "half_b", "variance"],
        "nonfinite": 0,
    }
    assert "visibility" not in facts["quantities"]


def test_inspect_takes_the_map(folder, scene, capfd):
    assert command.main(["inspect", str(folder), "--map", "depth=none", "--json"]) == 0
    assert "depth" not in json.loads(capfd.readouterr().out)["quantities"]
    assert command.main(["inspect", str(scene), "--map", "depth=none"]) == 2
    assert "a scene names its buffers itself; use --map with a folder or an image" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", ["not JSON"]),
        ('{"primitives": [{"type": "quad", "bsdf": {"type": "velvet"}}]}', ["velvet"]),
        ('{"primitives": [{"type": "mesh", "file": "gone.obj", "bsdf": {"type": "lambert"}}]}', ["gone.obj"]),
        (
            '{"primitives": [{"type": "quad", "bsdf": {"type": "lambert", "albedo": "gone.png"}}]}',
            ["gone.png"],
        ),
        ('{"renderer": {"spp": 0}}', ["renderer.spp", "at least 1"]),
        ("[1, 2]", []),
        ("", ["syntax error"]),
    ],
)
def test_bad_scenes(text, words, tmp_path, capfd, renders):
    path = tmp_path / "scene.json"
    path.write_text(text)
    fails(capfd, command.main(["inspect", str(path)]), path)
    fails(capfd, tungsten.main([str(path)]), path)
    assert list(tmp_path.iterdir()) == [path]


def test_compare(tmp_path, render, capfd):
    image, reference = tmp_path / "image.exr", tmp_path / "reference.pfm"
    write_image(image, render.buffers.color.mean)
    write_image(reference, render.reference)
    assert command.main(["compare", str(image), str(reference), "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    expected = tungsten_dip.compare(render.buffers.color.mean, render.reference)
    assert facts["psnr"] == pytest.approx(expected.psnr)
    assert set(facts) == {"psnr", "relmse", "ssim", "flip", "hdrflip", "nonfinite", "mean_ratio"}


def test_json_has_no_infinity(tmp_path, render, capfd):
    image = tmp_path / "image.exr"
    write_image(image, render.reference)
    assert command.main(["compare", str(image), str(image), "--json"]) == 0
    assert json.loads(capfd.readouterr().out, parse_constant=pytest.fail)["psnr"] is None


@pytest.mark.parametrize(
    ("name", "words"), [("none.exr", ["no such file"]), ("folder", ["this is a folder"])]
)
def test_compare_with_what_is_no_image(name, words, tmp_path, capfd):
    (tmp_path / "folder").mkdir()
    write_image(tmp_path / "image.exr", np.ones((2, 3, 3), np.float32))
    fails(capfd, command.main(["compare", str(tmp_path / "image.exr"), str(tmp_path / name)]), name, *words)


def test_compare_images_of_two_sizes(tmp_path, capfd):
    image, reference = tmp_path / "image.exr", tmp_path / "reference.exr"
    write_image(image, np.ones((4, 5, 3), np.float32))
    write_image(reference, np.ones((5, 4, 3), np.float32))
    expected = f"{image}: expected 4 x 5 pixels as {reference} has, got 5 x 4; bring both to one size"
    fails(capfd, command.main(["compare", str(image), str(reference)]), expected)


def test_compare_the_same_pixels_at_two_places(tmp_path, render, capfd):
    for name, column in (("there.exr", 5), ("here.exr", 0)):
        window = (np.array([column, 0], np.int32), np.array([column + 55, 39], np.int32))
        channels = {name: render.reference[..., index] for index, name in enumerate("RGB")}
        write_exr(tmp_path / name, [Part(channels, {"dataWindow": window})])
    write_image(tmp_path / "anywhere.pfm", render.reference)
    paths = [str(tmp_path / name) for name in ("there.exr", "here.exr", "anywhere.pfm")]
    assert command.main(["compare", *paths[:2]]) == 2
    fails(capfd, 2, "there.exr: expected pixels from (0, 0) on", "(5, 0)")
    assert command.main(["compare", *paths[::2]]) == 0
    assert command.main(["compare", paths[0], paths[0]]) == 0


def test_a_missing_part_of_the_package_is_named(folder, tmp_path, monkeypatch, capfd):
    def fit(*_, **__):
        raise ModuleNotFoundError("No module named 'drjit'", name="drjit")

    monkeypatch.setattr("tungsten_dip.cli.denoising.denoise", fit)
    arguments = ["denoise", str(folder), "-o", str(tmp_path / "out.exr")]
    fails(capfd, command.main(arguments), "pip install 'tungsten-dip[mitsuba]'")


def test_metrics_that_are_not_installed_are_named(tmp_path, monkeypatch, capfd):
    write_image(tmp_path / "image.exr", np.linspace(0, 1, 9 * 9 * 3, dtype=np.float32).reshape(9, 9, 3))
    for package in ("flip_evaluator", "skimage"):
        monkeypatch.setitem(sys.modules, package, None)
    image = str(tmp_path / "image.exr")
    assert command.main(["compare", image, image, "--json"]) == 0
    out, err = capfd.readouterr()
    facts = json.loads(out)
    assert facts["relmse"] == 0
    assert facts["ssim"] is facts["flip"] is facts["hdrflip"] is None
    assert err.count("pip install 'tungsten-dip[compare]'") == 2


def test_results_with_a_name_that_is_no_text_are_told(folder, tmp_path):
    picture = tmp_path / os.fsdecode(b"bad\xff.exr")
    options = ["denoise", str(folder), "-o", str(picture), "--preset", "draft", "--iterations", "2"]
    program = [sys.executable, "-c", MAIN.format("tungsten_dip"), *options]
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    done = subprocess.run(program, capture_output=True, check=False, env=environment)
    assert done.returncode == 0
    assert b"bad\\udcff.exr: 2 iterations" in done.stdout
    assert picture.exists()


def test_names_beyond_ascii_are_read_and_written_in_any_locale(folder, tmp_path):
    given, picture = folder.rename(tmp_path / "räume"), tmp_path / "größe.exr"
    options = ["denoise", str(given), "-o", str(picture), "--preset", "draft", "--iterations", "2"]
    program = [sys.executable, "-c", MAIN.format("tungsten_dip"), *options]
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    for name in ("page.html", "größe.html"):
        done = subprocess.run(
            [*program, "--report", str(tmp_path / name)],
            capture_output=True,
            check=False,
            env={**os.environ, **ascii_only},
        )
        assert done.returncode == 0, done.stderr
        assert picture.exists()
        assert (tmp_path / name).exists()


def test_an_error_map_is_written_where_no_network_was_fitted(tmp_path, render, capfd):
    clean = Buffer(render.reference, render.reference, render.reference * np.float32(1.0001))
    write_tungsten_folder(tmp_path / "clean", RenderBuffers(clean))
    files = [str(tmp_path / name) for name in ("out.exr", "error.exr", "model.onnx")]
    options = ["-o", files[0], "--error-map", files[1], "--save-model", files[2]]
    assert command.main(["denoise", str(tmp_path / "clean"), *options]) == 2
    assert "no network was fitted" in capfd.readouterr().err
    assert [Path(file).exists() for file in files] == [True, True, False]


@pytest.mark.parametrize("plane", ["color", "colorA", "normalVariance"])
def test_buffers_are_not_written_over(folder, tmp_path, fits, capfd, plane):
    path = folder / f"{plane}.exr"
    before = path.read_bytes()
    for options in (["-o", str(path)], ["-o", str(tmp_path / "o.exr"), "--error-map", str(path)]):
        assert command.main(["denoise", str(folder), *options]) == 2
        fails(capfd, 2, str(path), "one of the files that are read")
    assert path.read_bytes() == before
    single = tmp_path / "single.exr"
    assert command.main(["denoise", str(folder), "-o", str(single)]) == 0
    assert command.main(["denoise", str(single), "-o", str(single)]) == 0  # all layers are in the result


@pytest.mark.parametrize("name", ["color.exr", "albedoB.EXR", "depth.exr", "beauty.exr"])
def test_no_output_takes_the_name_of_a_buffer(tmp_path, render, fits, capfd, monkeypatch, name):
    for stem in ("color", "beauty"):
        write_image(tmp_path / f"{stem}.pfm", render.buffers.color.mean)
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    for options in (["-o", name], ["-o", "../o.exr", "--error-map", f"./{name}"]):
        status = command.main(["denoise", ".", "--map", "color=beauty", "--map", "depth=none", *options])
        fails(capfd, status, name, "one of the files that are read")
    assert sorted(tmp_path.iterdir()) == before
    assert command.main(["denoise", "color.pfm", "-o", name]) == 0  # one file is no folder


def test_a_folder_may_hold_its_result_under_another_name(folder, fits):
    options = ["-o", str(folder / "denoised.exr"), "--error-map", str(folder / "none.exr")]
    for _ in range(2):
        assert command.main(["denoise", str(folder), "--map", "normal=none", *options]) == 0
