import io
import json
import logging
import os
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO
import pytest

import tungsten_dip
from conftest import SCENE
from tungsten_dip.buffers import (
    Buffer,
    RenderBuffers,
    read_buffers,
    read_image,
    write_image,
    write_tungsten_folder,
)
from tungsten_dip.buffers.image_file import write_exr
from tungsten_dip.buffers.source import Part
from tungsten_dip.cli import console, denoising, entry, tungsten
from tungsten_dip.cli import tungsten_dip as command
from tungsten_dip.cli.console import duration, minutes, progress_on_stderr
from tungsten_dip.cli.scene_outputs import SceneOutputs, write_render
from tungsten_dip.errors import InputError
from tungsten_dip.fit.result import FitResult, HistoryPoint
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.interrupts import held_interrupts
from tungsten_dip.progress import silent
from tungsten_dip.scene.types import OutputBuffer
from tungsten_dip.sequence.following import Followed

MAIN = "import sys; from tungsten_dip.cli.{} import main; sys.exit(main())"
"""What the installed commands do."""


def write_scene(path, **renderer):
    scene = {**SCENE, "renderer": {**SCENE["renderer"], **renderer}}
    path.write_text(json.dumps(scene))
    return path


def write_frames(folder, *names):
    """Write scenes that make pictures alone, each of its own name; return their paths."""
    files = {"hdr_output_file": "", "output_buffers": []}
    return [write_scene(folder / f"{name}.json", output_file=f"{name}.png", **files) for name in names]


@pytest.fixture
def scene(tmp_path):
    return write_scene(tmp_path / "scene.json")


@pytest.fixture
def folder(tmp_path, render):
    write_tungsten_folder(tmp_path / "buffers", render.buffers)
    return tmp_path / "buffers"


@pytest.fixture
def fits(monkeypatch):
    """Replaces the fit by its mean colour; lists the settings that it was called with."""
    calls = []

    def denoise(buffers, settings=None, progress=silent, warm_start=None):
        settings = settings or FitSettings()
        calls.append(settings)
        os.write(1, b"a library that chatters on stdout\n")
        progress(0.5, "halfway")
        color = np.broadcast_to(buffers.color.mean.mean((0, 1)), buffers.color.mean.shape).copy()
        error = np.full((buffers.height, buffers.width, 1), 0.25, np.float32)
        known = buffers.color.halves is not None
        return FitResult(
            color=color,
            settings=settings,
            seconds=1.5,
            iterations=7,
            error=error if known else None,
            estimated_relmse=0.25 if known else None,
            history=(HistoryPoint(0.5, 3, 0.5), HistoryPoint(1.5, 7, 0.25)),
        )

    monkeypatch.setattr("tungsten_dip.cli.denoising.denoise", denoise)
    return calls


@pytest.fixture
def renders(monkeypatch, make_render):
    """Replaces Mitsuba by the synthetic render; lists what it was asked for."""
    calls = []

    def render(scene, *, spp, seed, threads, timeout_s, progress, quantities):
        calls.append({"spp": spp, "seed": seed, "timeout_s": timeout_s, "quantities": quantities})
        width, height = scene.camera.resolution
        buffers = make_render(height, width, seed=seed).buffers
        unwanted = {"albedo", "normal", "depth"}.difference(quantities)
        return buffers.with_quantities(**dict.fromkeys(unwanted))

    monkeypatch.setattr("tungsten_dip.cli.tungsten.render_with_mitsuba", render)
    monkeypatch.setattr("tungsten_dip.hosts.tungsten.available", lambda: False)
    return calls


def fails(capfd, status, *words):
    """Assert that the command ended with one line that holds the words, and that stdout stayed empty."""
    out, err = capfd.readouterr()
    assert status == 2
    assert out == ""
    assert "Traceback" not in err
    last = err.splitlines()[-1]
    assert last.startswith(("tungsten-dip: ", "tungsten: "))
    assert all(str(word) in last for word in words), last


# --- tungsten-dip denoise ---------------------------------------------------------------------------


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
        ("{folder} -o {tmp}/out.exr --time-budget 0", ["time_budget_s"]),
        ("{folder} -o {tmp}/out.exr --time-budget=-5s", ["--time-budget", "90s", "-5s"]),
        ("{folder} -o {tmp}/out.exr --iterations -1", ["iterations"]),
        ("{folder} -o {tmp}/out.exr --target-error nan", ["target_error"]),
        ("{folder} -o {tmp}/out.exr --network resnet", ["network", "preset paper"]),
        ("{folder} -o {tmp}/out.exr --preset paper --channels 8,x", ["--channels", "integers such as"]),
        ("{folder} -o {tmp}/out.exr --map color", ["--map", "NAME=CHANNEL"]),
        ("{folder} -o {tmp}/out.exr --map beauty=x", ["beauty"]),
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


# --- tungsten-dip inspect and compare ---------------------------------------------------------------


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
    fails(capfd, command.main(["compare", str(image), str(reference)]), "(4, 5, 3)", "(5, 4, 3)")


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


# --- tungsten ---------------------------------------------------------------------------------------


def test_a_render_writes_what_the_scene_asks_for(scene, tmp_path, renders):
    assert tungsten.main([str(scene)]) == 0
    names = {path.name for path in tmp_path.iterdir()} - {"scene.json"}
    normals = {f"n{plane}{suffix}" for plane in ("", "A", "B", "Variance") for suffix in (".exr", ".png")}
    assert names == {"picture.png", "picture.exr", "z.pfm"} | normals
    assert renders == [
        {"spp": None, "seed": 0, "timeout_s": None, "quantities": ["color", "normal", "depth"]}
    ]
    width, height = SCENE["camera"]["resolution"]
    assert read_image(tmp_path / "picture.exr").shape == (height, width, 3)


def test_no_plane_of_an_earlier_render_stays(scene, tmp_path, capfd):
    before = {}
    for spp in (2, 1, 2):
        assert tungsten.main(["--host", "mitsuba", "--spp", str(spp), str(scene)]) == 0
        before[spp] = {path.name for path in tmp_path.iterdir()}
    planes = {f"n{plane}{suffix}" for plane in ("A", "B", "Variance") for suffix in (".exr", ".png")}
    assert before[2] - before[1] == planes
    removed = [line for line in capfd.readouterr().err.splitlines() if "removed what an earlier" in line]
    assert len(removed) == 1
    assert all(name in removed[0] for name in planes)


def test_denoised_pictures_lie_beside_the_noisy_ones(tmp_path, renders, fits, capfd):
    scene = write_scene(tmp_path / "scene.json", hdr_output_file="", output_buffers=[])
    report = tmp_path / "page.html"
    options = (
        f"--dip-denoise --dip-preset draft --dip-time-budget 5 --dip-report {report} --spp 8 -s 3 --timeout 2"
    )
    assert tungsten.main([*options.split(), "-d", str(tmp_path / "new" / "out"), str(scene)]) == 0
    assert {path.name for path in (tmp_path / "new" / "out").iterdir()} == {
        "picture.png",
        "picture.exr",
        "picture_denoised.exr",
        "picture_denoised.png",
        "picture_side_by_side.png",
    }
    assert fits == [FitSettings("draft", time_budget_s=5.0)]
    (asked,) = renders
    assert (asked["spp"], asked["seed"], asked["timeout_s"]) == (8, 3, 120.0)
    assert {"color", "normal", "depth"} <= set(asked["quantities"])
    assert "picture" in report.read_text()
    assert capfd.readouterr().err.count("wrote ") == 6


def test_pictures_of_unknown_types_are_written_as_known_ones(tmp_path, renders, caplog):
    buffers = [
        {"type": "albedo", "hdr_output_file": "albedo.hdr"},
        {"type": "normal", "hdr_output_file": "normal.hdr"},  # which holds no sign
        {"type": "depth", "hdr_output_file": "depth.tif"},
    ]
    scene = write_scene(
        tmp_path / "scene.json", output_file="a.jpg", hdr_output_file="b", output_buffers=buffers
    )
    assert tungsten.main(["--host", "mitsuba", str(scene)]) == 0
    written = {path.name for path in tmp_path.iterdir()} - {scene.name}
    assert written == {"a.png", "b.exr", "albedo.hdr", "normal.exr", "depth.exr"}


def test_buffers_of_unknown_types_are_found_as_what_they_were_written(tmp_path, renders):
    buffers = [{"type": "normal", "hdr_output_file": "n.tif"}]
    scene = write_scene(tmp_path / "scene.json", hdr_output_file="b.v2", output_buffers=buffers)
    assert tungsten.main(["--host", "mitsuba", str(scene)]) == 0
    buffers = read_buffers(scene)
    assert np.array_equal(buffers.color.mean, read_image(tmp_path / "b.exr"))
    assert np.array_equal(buffers.normal.mean, read_image(tmp_path / "n.exr"))


@pytest.mark.parametrize("name", ["sub/", "sub/.png", ".PNG", ".", ".."])
def test_a_name_of_no_file_is_refused(name, tmp_path, renders, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub").mkdir()
    write_scene(Path("scene.json"), output_file=name)
    fails(capfd, tungsten.main(["--dip-denoise", "scene.json"]), f"{name}: expected the name of a file")
    assert renders == []


def test_a_picture_that_does_not_fit_into_memory_is_one_line(scene, capfd, monkeypatch):
    monkeypatch.setattr("tungsten_dip.hosts.memory._available_bytes", lambda: 17 * 9 * 100)
    assert tungsten.main(["--spp", "2", str(scene)]) == 2
    assert "got 17 x 9; lower the resolution of the camera" in capfd.readouterr().err
    assert [path.name for path in scene.parent.iterdir()] == [scene.name]


def test_output_files_of_the_command_line(scene, tmp_path, renders, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub").mkdir()
    assert tungsten.main(["-o", "sub/a.png", "-e", "sub/b.pfm", str(scene)]) == 0
    assert {path.name for path in (tmp_path / "sub").iterdir()} == {"a.png", "b.pfm"}
    assert not (tmp_path / "picture.png").exists()


def test_files_are_numbered_where_the_scene_forbids_overwriting(tmp_path, renders):
    scene = write_scene(tmp_path / "scene.json", overwrite_output_files=False, output_buffers=[])
    for _ in range(3):
        assert tungsten.main([str(scene)]) == 0
    assert {path.name for path in tmp_path.glob("picture*")} == {
        f"picture{number}{suffix}" for number in ("", "001", "002") for suffix in (".png", ".exr")
    }


@pytest.mark.parametrize("removed", ["picture.png", "picture.exr", "picture_denoised.exr"])
def test_the_number_is_free_for_every_picture(removed, tmp_path, renders, fits):
    scene = write_scene(
        tmp_path / "scene.json", overwrite_output_files=False, hdr_output_file="", output_buffers=[]
    )
    assert tungsten.main(["--dip-denoise", str(scene)]) == 0
    (tmp_path / removed).unlink()
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert tungsten.main(["--dip-denoise", "--seed", "5", str(scene)]) == 0
    assert {path: path.read_bytes() for path in before} == before
    assert {path.name for path in tmp_path.iterdir() if path not in before} == {
        "picture001.png",
        "picture001.exr",
        "picture001_denoised.exr",
        "picture001_denoised.png",
        "picture001_side_by_side.png",
    }


def test_an_interrupted_fit_leaves_the_render_and_the_scenes_before_it(
    tmp_path, renders, fits, capfd, monkeypatch
):
    scenes = write_frames(tmp_path, "one", "two", "three")
    finished = denoising.denoise

    def interrupted(buffers, settings, progress, warm_start=None, previous=None):
        if fits:
            raise KeyboardInterrupt
        return finished(buffers, settings, progress)

    monkeypatch.setattr("tungsten_dip.sequence.following.fit_fusion", interrupted)
    assert tungsten.main(["--dip-denoise", *map(str, scenes)]) == 130
    names = {path.name for path in tmp_path.iterdir()} - {path.name for path in scenes}
    assert names == {
        "one.png",
        "one.exr",
        "one_denoised.exr",
        "one_denoised.png",
        "one_side_by_side.png",
        "two.png",
        "two.exr",
    }
    assert capfd.readouterr().err.splitlines()[-1] == "tungsten: interrupted"


@pytest.mark.parametrize("options", [[], ["--dip-denoise"]])
@pytest.mark.parametrize("second", ["b.json", "sub/../a.json"])
def test_scenes_that_would_write_over_one_another_are_refused(second, options, tmp_path, renders, capfd):
    (tmp_path / "sub").mkdir()
    scenes = [write_scene(tmp_path / name) for name in ("a.json", second)]
    assert tungsten.main([*options, "--host", "mitsuba", *map(str, scenes)]) == 2
    assert f"{second}: would write over" in capfd.readouterr().err
    assert len(renders) == 1


def test_a_scene_that_failed_has_written_nothing_to_keep(tmp_path, renders, capfd, monkeypatch):
    render, seen = tungsten.render_with_mitsuba, []

    def fails_at_first(scene, **options):
        seen.append(scene)
        if len(seen) == 1:
            raise InputError("a light that there is not")
        return render(scene, **options)

    monkeypatch.setattr("tungsten_dip.cli.tungsten.render_with_mitsuba", fails_at_first)
    scenes = [str(write_scene(tmp_path / name)) for name in ("a.json", "b.json")]
    assert tungsten.main(["--host", "mitsuba", *scenes]) == 2
    assert "1 of 2 scenes failed" in capfd.readouterr().err
    assert len(renders) == 1


def test_negative_radiance_is_black_in_a_hdr_and_loses_no_render(tmp_path, caplog):
    radiance = np.full((2, 3, 3), 0.5, np.float32)
    radiance[0, 0] = -0.25
    picture, buffer = tmp_path / "picture.hdr", tmp_path / "buffer.hdr"
    request = OutputBuffer(type="color", hdr_output_file=str(buffer))
    write_render(RenderBuffers(Buffer(radiance)), SceneOutputs(None, picture, (request,)), "gamma")
    for path in (picture, buffer):
        np.testing.assert_array_equal(read_image(path), np.maximum(radiance, 0))
        assert f"{path}: holds no negative values" in caplog.text


@pytest.mark.parametrize(
    ("shared", "renderer"), [("picture.exr", {"output_buffers": []}), ("n.exr", {"hdr_output_file": ""})]
)
def test_scenes_that_share_one_file_alone_are_refused(shared, renderer, tmp_path, renders, capfd):
    scenes = [
        str(write_scene(tmp_path / f"{name}.json", output_file=f"{name}.png", **renderer))
        for name in ("one", "two")
    ]
    assert tungsten.main(["--dip-denoise", *scenes]) == 2
    assert f"two.json: would write over {tmp_path / shared}" in capfd.readouterr().err
    assert len(renders) == 1


def test_a_scene_whose_buffers_would_write_over_a_picture_is_refused(tmp_path, renders, capfd):
    buffers = [{"type": "normal", "hdr_output_file": "one_denoised.exr"}]
    one = write_scene(tmp_path / "a.json", output_file="one.png", hdr_output_file="", output_buffers=[])
    two = write_scene(tmp_path / "b.json", output_file="two.png", output_buffers=buffers)
    assert tungsten.main(["--dip-denoise", str(one), str(two)]) == 2
    assert "b.json: would write over" in capfd.readouterr().err
    assert len(renders) == 1


@pytest.mark.parametrize("name", ["picture_denoised.exr", "sub/../picture_denoised.exr"])
@pytest.mark.parametrize("given", ["option", "buffer"])
def test_a_render_that_the_denoised_picture_would_write_over_is_refused(
    name, given, tmp_path, renders, capfd, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub").mkdir()
    buffers = [{"type": "normal", "hdr_output_file": name}] if given == "buffer" else []
    scene = write_scene(tmp_path / "scene.json", output_buffers=buffers)
    options = ["-e", name] if given == "option" else []
    assert tungsten.main(["--dip-denoise", *options, str(scene)]) == 2
    fails(capfd, 2, "picture_denoised.exr: named for the render")
    assert renders == []


@pytest.mark.parametrize(
    ("texture", "options"),
    [
        ("t.exr", ["-e", "t.exr"]),
        ("picture.png", []),
        ("nA.exr", []),
        ("picture_denoised.png", ["--dip-denoise"]),
    ],
)
def test_what_the_scene_reads_is_not_written_over(
    texture, options, tmp_path, renders, render, capfd, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    write_image(texture, render.reference)
    before = Path(texture).read_bytes()
    bsdf = {"name": "grey", "type": "lambert", "albedo": texture}
    Path("scene.json").write_text(json.dumps({**SCENE, "bsdfs": [bsdf]}))
    fails(capfd, tungsten.main([*options, "scene.json"]), texture, "one of the files that are read")
    assert Path(texture).read_bytes() == before
    assert renders == []


@pytest.mark.parametrize(
    ("hdr", "buffers", "words"),
    [
        ("", [("albedo", "picture.exr")], "picture.exr: named for color and for albedo"),
        ("c.exr", [("normal", "b.exr"), ("albedo", "./bA.exr")], "bA.exr: named for normalA and for albedo"),
    ],
)
def test_images_that_would_be_written_over_one_another_are_refused(
    hdr, buffers, words, tmp_path, renders, capfd
):
    requests = [
        {"type": quantity, "hdr_output_file": name, "two_buffer_variance": quantity == "normal"}
        for quantity, name in buffers
    ]
    scene = write_scene(tmp_path / "scene.json", hdr_output_file=hdr, output_buffers=requests)
    fails(capfd, tungsten.main(["--dip-denoise", str(scene)]), words, "name two files")
    assert renders == []


@pytest.mark.parametrize("name", ["a\0b", "a\ud800"])
@pytest.mark.parametrize("field", ["output_file", "hdr_output_file", "output_directory"])
def test_names_that_no_file_can_have_are_one_line(field, name, tmp_path, renders, capfd):
    suffix = {"output_file": ".png", "hdr_output_file": ".exr", "output_directory": ""}[field]
    scene = write_scene(tmp_path / "scene.json", **{field: name + suffix})
    fails(capfd, tungsten.main([str(scene)]), "expected a name that a file can have")
    assert renders == []


def test_the_colour_may_be_named_twice(tmp_path, renders):
    buffers = [{"type": "color", "hdr_output_file": "picture.exr", "two_buffer_variance": True}]
    scene = write_scene(tmp_path / "scene.json", output_buffers=buffers)
    assert tungsten.main([str(scene)]) == 0
    assert {path.name for path in tmp_path.glob("*.exr")} == {"picture.exr", "pictureA.exr", "pictureB.exr"}


def test_several_scenes_are_frames_that_follow_one_another(tmp_path, renders, capfd, monkeypatch):
    calls = []

    class Follower:
        def __init__(self, settings, models):
            assert settings.preset == "draft"
            assert models.first is None

        def denoise(self, buffers, camera, progress):
            calls.append(camera.resolution)
            return Followed(FitResult(buffers.color.mean, FitSettings(), 1.0, 1), "followed")

    monkeypatch.setattr("tungsten_dip.sequence.following.Follower", Follower)
    scenes = [
        str(
            write_scene(
                tmp_path / f"f{number}.json",
                output_file=f"f{number}.png",
                hdr_output_file="",
                output_buffers=[],
            )
        )
        for number in range(3)
    ]
    assert tungsten.main(["--dip-denoise", "--dip-preset", "draft", "--seed", "5", *scenes]) == 0
    assert calls == [(17, 9)] * 3
    assert all((tmp_path / f"f{number}_denoised.exr").exists() for number in range(3))
    # The same noise in every frame would not average out.
    assert [call["seed"] for call in renders] == [5, 6, 7]


def test_the_seed_after_the_largest_is_0(tmp_path, renders, fits):
    rest = {"hdr_output_file": "", "output_buffers": []}
    scenes = [str(write_scene(tmp_path / f"{n}.json", output_file=f"{n}.png", **rest)) for n in range(3)]
    assert tungsten.main(["--dip-denoise", "--dip-preset", "draft", "--seed", str(2**32 - 1), *scenes]) == 0
    assert [call["seed"] for call in renders] == [2**32 - 1, 0, 1]


def test_a_bad_scene_does_not_keep_the_others_from_being_rendered(scene, tmp_path, renders, capfd):
    broken = tmp_path / "broken.json"
    broken.write_text("{")
    assert tungsten.main([str(broken), str(scene)]) == 2
    assert (tmp_path / "picture.png").exists()
    err = capfd.readouterr().err
    assert str(broken) in err
    assert err.splitlines()[-1] == "tungsten: 1 of 2 scenes failed, see above"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--dip-preset draft {scene}", ["--dip-denoise"]),
        ("--dip-denoise --dip-report {tmp}/none/r.html {scene}", ["{tmp}/none/r.html"]),
        ("--dip-denoise --dip-report {tmp}/r.html {scene} {scene}", ["one at a time"]),
        ("-o {tmp}/a.png {scene} {scene}", ["one at a time"]),
        ("--dip-save-model {tmp}/m.onnx {scene}", ["--dip-denoise"]),
        ("--dip-denoise --dip-save-model {tmp}/m.onnx {scene} {scene}", ["one at a time"]),
        ("--dip-denoise --dip-save-model {tmp}/m.pt {scene}", ["{tmp}/m.pt", ".onnx"]),
        ("--dip-denoise --dip-warm-start {tmp}/none.onnx {scene}", ["{tmp}/none.onnx", "cannot be read"]),
        ("-o {tmp}/none/a.png {scene}", ["{tmp}/none/a.png"]),
        ("-o {tmp}/a.jpg {scene}", ["{tmp}/a.jpg", ".png"]),
        ("-c 10m {scene}", ["--checkpoint", "--host tungsten"]),
        ("--host tungsten --dip-denoise --dip-preview -c 0 {scene}", ["--checkpoint 0", "--dip-preview"]),
        ("--timeout x {scene}", ["--timeout"]),
        ("--dip-denoise --dip-time-budget=-5 {scene}", ["--dip-time-budget", "-5"]),
        ("{tmp}/none.json", ["{tmp}/none.json", "found none"]),
        ("{tmp}", ["{tmp}", "found a folder"]),
        ("--nonsense {scene}", ["--nonsense"]),
    ],
)
def test_bad_options(arguments, words, scene, tmp_path, renders, fits, capfd):
    places = {"scene": scene, "tmp": tmp_path}
    status = tungsten.main(arguments.format(**places).split())
    fails(capfd, status, *(word.format(**places) for word in words))
    assert list(tmp_path.iterdir()) == [scene]
    assert not renders


def test_help_without_a_scene(capfd):
    assert tungsten.main([]) == 0
    assert "--dip-denoise" in capfd.readouterr().out


def test_a_render_by_mitsuba_and_a_fit(tmp_path):
    scene = write_scene(tmp_path / "scene.json", output_buffers=[])
    options = ["--host", "mitsuba", "--dip-denoise", "--dip-preset=draft", "--dip-time-budget=1s", "-t1"]
    program = [sys.executable, "-c", MAIN.format("tungsten"), *options, str(scene)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    noisy, denoised = read_image(tmp_path / "picture.exr"), read_image(tmp_path / "picture_denoised.exr")
    assert noisy.shape == denoised.shape == (9, 17, 3)
    assert np.isfinite(denoised).all()
    assert denoised.mean() == pytest.approx(noisy.mean(), rel=0.5)


def test_the_package_runs_as_the_command():
    program = [sys.executable, "-m", "tungsten_dip", "inspect", "nowhere.json"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("tungsten-dip: nowhere.json")


# --- Exit statuses and durations --------------------------------------------------------------------


def test_an_internal_error_is_one_line_and_a_traceback_only_on_demand(folder, tmp_path, monkeypatch, capfd):
    def broken(buffers, settings, progress, warm_start):
        raise RuntimeError("a bug\nin two lines")

    monkeypatch.setattr("tungsten_dip.cli.denoising.denoise", broken)
    arguments = ["denoise", str(folder), "-o", str(tmp_path / "out.exr")]
    assert command.main(arguments) == 1
    last = capfd.readouterr().err.splitlines()[-1]
    assert last.startswith("tungsten-dip: internal error: RuntimeError: a bug in two lines")
    monkeypatch.setenv("TUNGSTEN_DIP_DEBUG", "1")
    with pytest.raises(RuntimeError, match="a bug"):
        command.main(arguments)


def test_a_command_leaves_logging_and_stdout_as_they_were(folder, tmp_path, fits, capfd):
    logger = logging.getLogger("tungsten_dip")
    before = (list(logger.handlers), logger.level, logger.propagate)
    assert command.main(["denoise", str(folder), "-o", str(tmp_path / "out.exr"), "--json"]) == 0
    assert (list(logger.handlers), logger.level, logger.propagate) == before
    capfd.readouterr()
    os.write(1, b"still there")
    assert capfd.readouterr().out == "still there"


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


def test_a_reader_that_stops_early_is_no_error(scene):
    script = f"{sys.executable} -c '{MAIN.format('tungsten_dip')}' inspect {scene} | head -c 1"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert len(done.stdout) == 1
    assert "rror" not in done.stderr


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90s", 90), ("5m", 300), ("1.5h", 5400), ("1h30m", 5400), ("250ms", 0.25), ("2 m", 120), ("45", 45)],
)
def test_durations(text, seconds):
    assert duration(text) == pytest.approx(seconds)


def test_a_bare_number_means_minutes_to_tungsten():
    assert minutes("2") == 120
    assert minutes("2s") == 2


@pytest.mark.parametrize("text", ["", "soon", "-5s", "5x", "5s later", "s", "1e3", "nan"])
def test_texts_that_are_no_duration(text):
    with pytest.raises(Exception, match="expected a duration"):
        duration(text)


def test_torch_is_missed_before_the_render(tmp_path, scene, monkeypatch, capfd):
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: None)
    assert (
        tungsten.main(["--dip-denoise", "--dip-preset", "paper", "-d", str(tmp_path / "out"), str(scene)])
        == 2
    )
    captured = capfd.readouterr()
    assert "pip install 'tungsten-dip[fit]'" in captured.err
    assert "Traceback" not in captured.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("redirection", [">&-", "2>&-", ">&- 2>&-", "2>/dev/full"])
def test_work_is_done_without_anybody_to_talk_to(redirection, tmp_path, folder):
    picture = tmp_path / "picture.exr"
    options = ["denoise", str(folder), "-o", str(picture), "--preset", "draft", "--iterations", "2"]
    program = shlex.join([sys.executable, "-c", MAIN.format("tungsten_dip"), *options])
    done = subprocess.run(["bash", "-c", f"{program} {redirection}"], capture_output=True, check=False)
    assert done.returncode == 0
    assert np.isfinite(read_image(picture)).all()


def test_a_name_that_is_no_text_is_refused_in_a_line(tmp_path, render, capfd):
    path = tmp_path / os.fsdecode(b"bad\xff.exr")
    write_image(path, render.reference)
    assert command.main(["inspect", str(path)]) == 2
    _, errors = capfd.readouterr()
    assert "expected a name in UTF-8; rename it" in errors
    assert len(errors.splitlines()) == 1


def test_control_characters_of_a_file_do_not_reach_the_terminal(tmp_path, capfd):
    path = tmp_path / "\x1b[31m.exr"
    layer = "\x1b]0;title\x07"
    names = (*"RGB", f"{layer}.U", f"{layer}.V")
    write_exr(path, [Part(dict.fromkeys(names, np.ones((3, 4), np.float32)))])
    assert command.main(["inspect", str(path)]) == 0
    output = str(tmp_path / "out.exr")
    assert command.main(["denoise", str(path), "-o", output, "--map", f"color={layer}"]) == 2
    told = "".join(capfd.readouterr())
    assert r"ignored: \x1b]0;title\x07" in told
    assert r"color=\x1b]0;title\x07: expected" in told
    assert not {"\x1b", "\x07"} & set(told)


@pytest.mark.parametrize("terminal", [True, False])
def test_control_characters_do_not_reach_the_terminal_by_the_progress(terminal, monkeypatch):
    stderr = io.StringIO()
    stderr.isatty = lambda: terminal
    monkeypatch.setattr(sys, "stderr", stderr)
    monkeypatch.setattr(console, "LINE_INTERVAL_S", 0.0)
    with progress_on_stderr("rendering \x1b]0;a\x07") as progress:
        progress(0.5, "frame \x9b31m")
    told = stderr.getvalue()
    assert r"rendering \x1b]0;a\x07" in told
    assert r"frame \x9b31m" in told
    assert not {"\x07", "\x9b"} & set(told)
    assert "\x1b]" not in told  # a bar moves the cursor by other sequences


def test_results_with_a_name_that_is_no_text_are_told(folder, tmp_path):
    picture = tmp_path / os.fsdecode(b"bad\xff.exr")
    options = ["denoise", str(folder), "-o", str(picture), "--preset", "draft", "--iterations", "2"]
    program = [sys.executable, "-c", MAIN.format("tungsten_dip"), *options]
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    done = subprocess.run(program, capture_output=True, check=False, env=environment)
    assert done.returncode == 0
    assert b"bad\\udcff.exr: 2 iterations" in done.stdout
    assert picture.exists()


@pytest.mark.parametrize(
    ("of_scene", "given", "expected"),
    [("0", [], 60), ("5", [], None), ("0", ["-c", "90s"], 90), ("x", [], "checkpoint_interval: expected")],
)
def test_a_preview_is_made_every_minute_where_no_other_time_is_named(
    of_scene, given, expected, tmp_path, monkeypatch, capfd
):
    def drive(path, options, on_checkpoint, progress):
        asked.append(options.checkpoint_interval_s)
        raise InputError("enough")

    asked = []
    monkeypatch.setattr(tungsten.tungsten_host, "in_process", lambda: True)
    monkeypatch.setattr(tungsten.tungsten_host, "drive", drive)
    scene = write_scene(tmp_path / "scene.json", checkpoint_interval=of_scene)
    options = ["--host", "tungsten", "--dip-denoise", "--dip-preview", *given, str(scene)]
    if isinstance(expected, str):
        fails(capfd, tungsten.main(options), expected)
    else:
        fails(capfd, tungsten.main(options), "enough")
        assert asked == [expected]


def test_ctrl_c_in_the_fit_of_a_preview_ends_the_render(tmp_path, fits, render, monkeypatch):
    finished = denoising.denoise
    monkeypatch.setattr(
        "tungsten_dip.cli.denoising.denoise",
        lambda *given, **more: replace(finished(*given, **more), interrupted=True),
    )
    outputs = tungsten.SceneOutputs(tmp_path / "room.png", tmp_path / "room.exr")
    preview = tungsten._preview(outputs, FitSettings())
    with pytest.raises(KeyboardInterrupt):
        preview(tungsten.tungsten_host.Rendered(render.buffers, None, None, "gamma"))
    assert (tmp_path / "room_preview.png").exists()


def test_an_error_map_is_written_where_no_network_was_fitted(tmp_path, render, capfd):
    clean = Buffer(render.reference, render.reference, render.reference * np.float32(1.0001))
    write_tungsten_folder(tmp_path / "clean", RenderBuffers(clean))
    files = [str(tmp_path / name) for name in ("out.exr", "error.exr", "model.onnx")]
    options = ["-o", files[0], "--error-map", files[1], "--save-model", files[2]]
    assert command.main(["denoise", str(tmp_path / "clean"), *options]) == 2
    assert "no network was fitted" in capfd.readouterr().err
    assert [Path(file).exists() for file in files] == [True, True, False]


def test_a_fit_that_ended_early_ends_the_command(tmp_path, renders, fits, monkeypatch):
    scenes = [write_scene(tmp_path / f"{name}.json", output_file=f"{name}.png") for name in ("one", "two")]
    finished = denoising.denoise
    monkeypatch.setattr(
        "tungsten_dip.cli.denoising.denoise",
        lambda *given, **more: replace(finished(*given, **more), interrupted=True),
    )
    assert tungsten.main(["--dip-denoise", "-o", str(tmp_path / "one.png"), str(scenes[0])]) == 130
    assert (tmp_path / "one_denoised.exr").exists()
    frames = []

    class Follower:
        def __init__(self, *given, **more):
            pass

        def denoise(self, buffers, camera, progress):
            frames.append(buffers)
            return Followed(replace(finished(buffers), interrupted=True), "fitted")

    monkeypatch.setattr("tungsten_dip.sequence.following.Follower", Follower)
    assert tungsten.main(["--dip-denoise", "--host", "mitsuba", *map(str, scenes)]) == 130
    assert len(frames) == 1


def test_options_may_stand_between_scenes(tmp_path, renders):
    scenes = write_frames(tmp_path, "one", "two")
    assert tungsten.main([str(scenes[0]), "-t", "1", str(scenes[1])]) == 0
    assert (tmp_path / "two.png").exists()


@pytest.mark.parametrize(
    ("renderer", "options", "words"),
    [
        ({"timeout": "abc"}, [], ("renderer.timeout", "duration", "abc")),
        ({}, ["--spp", "9" * 10], ("spp", "9" * 10)),
    ],
)
def test_numbers_that_mitsuba_cannot_take(tmp_path, capfd, renderer, options, words):
    path = write_scene(tmp_path / "scene.json", **renderer)
    assert tungsten.main([*options, "--host", "mitsuba", str(path)]) == 2
    fails(capfd, 2, *words)


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


@pytest.mark.parametrize("buffered", [True, False])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("tungsten_dip", "inspect {folder}"),
        ("tungsten_dip", "inspect {folder} --json"),
        ("tungsten_dip", "compare --help"),
        ("tungsten_dip", "--version"),
        ("tungsten", ""),
    ],
)
def test_a_stdout_that_is_full_is_named(name, options, buffered, folder):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", MAIN.format(name), *options.format(folder=folder).split()],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"},
        )
    assert done.returncode == 2
    assert "stdout: cannot be written (No space left on device); " in done.stderr.splitlines()[-1]


def test_ctrl_c_while_libraries_load_is_one_line():
    program = (
        "import signal; from tungsten_dip.cli import entry\n"
        "with entry._leaving_on_interrupt('tungsten'): signal.raise_signal(signal.SIGINT)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "tungsten: interrupted\n")


def test_ctrl_c_that_a_handler_in_c_has_is_left_to_it(monkeypatch):
    handler = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as of_c:
        of_c.setattr(signal, "getsignal", lambda number: None)
        with entry._leaving_on_interrupt("tungsten"):
            assert signal.signal(signal.SIGINT, handler) is handler


def test_ctrl_c_that_is_ignored_does_not_end_a_render(scene):
    program = (
        "import os, signal, sys\n"
        "from tungsten_dip.cli import entry\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "with entry._leaving_on_interrupt('tungsten'):\n"
        "    from tungsten_dip.hosts.mitsuba.render import render\n"
        "    from tungsten_dip.scene.parse import load_scene\n"
        "pressed = []\n"
        "def press(fraction, message):\n"
        "    if fraction < 1:\n"
        "        pressed.append(os.kill(os.getpid(), signal.SIGINT))\n"
        "render(load_scene(sys.argv[1]), spp=20000, threads=1, progress=press)\n"
        "assert pressed\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(scene)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("folder", [[], ["-d", "{tmp}/out"]])
def test_a_working_directory_that_is_gone_is_one_line(folder, scene, tmp_path):
    (tmp_path / "gone").mkdir()
    program = MAIN.format("tungsten").replace("sys.exit", "import os; os.rmdir(os.getcwd()); sys.exit")
    folder = [word.format(tmp=tmp_path) for word in folder]
    arguments = ["--host", "mitsuba", "--spp", "1", *folder, str(scene)]
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], cwd=tmp_path / "gone", capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "tungsten: the working directory does not exist any more" in done.stderr.splitlines()[-1]


def test_renders_in_a_working_directory_whose_name_is_no_text(scene, tmp_path):
    folder = tmp_path / os.fsdecode(b"bad\xff")
    folder.mkdir()
    arguments = ["--host", "mitsuba", "--spp", "1", "-d", str(tmp_path / "out"), str(scene)]
    done = subprocess.run(
        [sys.executable, "-c", MAIN.format("tungsten"), *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "picture.exr").exists()


def test_ctrl_c_waits_for_an_import():
    reached = []

    def load():
        with held_interrupts():
            signal.raise_signal(signal.SIGINT)
            reached.append("the end")

    with pytest.raises(KeyboardInterrupt):
        load()
    assert reached == ["the end"]


def test_ctrl_c_that_is_ignored_stays_so():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with held_interrupts():
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_what_the_fit_lacks_is_told_before_the_render(tmp_path, monkeypatch, capfd):
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps(SCENE))
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: None)
    monkeypatch.setattr("onnxruntime.get_available_providers", list)
    lacks = {("--dip-pilot", "oidn"): "needs pyoidn", ("--dip-device", "cuda"): "expected an onnxruntime"}
    for option, told in lacks.items():
        assert tungsten.main(["--host", "mitsuba", "--dip-denoise", *option, str(scene)]) == 2
        assert told in capfd.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["scene.json"]
