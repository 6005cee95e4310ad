"""The command ``tungsten``: what it writes and refuses, and what denoising adds."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from commands import MAIN, SCENE, fails, write_frames, write_scene
from tungsten_dip.buffers.image_file import MOST_HDR, write_image
from tungsten_dip.buffers.read import read_buffers, read_image
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.cli import denoising, tungsten
from tungsten_dip.cli.scene_outputs import SceneOutputs, write_render
from tungsten_dip.errors import InputError
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.scene.types import OutputBuffer
from tungsten_dip.sequence.following import Followed


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


def test_scenes_that_forbid_overwriting_may_share_a_name(tmp_path, renders):
    kept = {"overwrite_output_files": False, "output_buffers": []}
    scenes = [str(write_scene(tmp_path / name, **kept)) for name in ("a.json", "b.json")]
    assert tungsten.main(["--host", "mitsuba", *scenes]) == 0
    assert {path.name for path in tmp_path.glob("picture*")} == {
        f"picture{number}{suffix}" for number in ("", "001") for suffix in (".png", ".exr")
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

    monkeypatch.setattr("tungsten_dip.sequence.following.fit_blend", interrupted)
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


@pytest.mark.parametrize("wrong", ["names", "content"])
def test_what_is_wrong_with_a_later_scene_is_told_before_the_first_render(
    wrong, tmp_path, renders, capfd, monkeypatch
):
    render, told = tungsten.render_with_mitsuba, []

    def listed(scene, **options):
        told.append(capfd.readouterr().err)
        return render(scene, **options)

    monkeypatch.setattr("tungsten_dip.cli.tungsten.render_with_mitsuba", listed)
    scenes = [write_scene(tmp_path / name) for name in ("a.json", "b.json")]
    if wrong == "content":
        scenes[1].write_text("{")
    assert tungsten.main(["--host", "mitsuba", *map(str, scenes)]) == 2
    assert len(told) == 1
    assert f"{scenes[1]}:" in told[0]
    assert "1 of 2 scenes failed" in capfd.readouterr().err


def test_radiance_that_a_hdr_does_not_hold_is_clipped_and_loses_no_render(tmp_path, caplog):
    radiance = np.full((2, 3, 3), 0.5, np.float32)
    radiance[0] = np.array([[-0.25], [np.nan], [np.inf]])
    picture, buffer = tmp_path / "picture.hdr", tmp_path / "buffer.hdr"
    request = OutputBuffer(type="color", hdr_output_file=str(buffer))
    write_render(RenderBuffers(Buffer(radiance)), SceneOutputs(None, picture, (request,)), "gamma")
    for path in (picture, buffer):
        image = read_image(path)
        np.testing.assert_array_equal(image[0, :2], 0)
        np.testing.assert_allclose(image[0, 2], MOST_HDR, rtol=1 / 128)
        np.testing.assert_array_equal(image[1], radiance[1])
        assert f"{path}: holds 0 to 1.7e+38" in caplog.text


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


@pytest.mark.parametrize("names", [("a", "b"), ("b", "a")])
def test_a_scene_that_would_write_over_what_another_reads_is_refused(names, tmp_path, renders, capfd):
    texture = np.full((4, 4, 3), 0.5, np.float32)
    write_image(tmp_path / "wood.png", texture)
    bsdf = {"name": "grey", "type": "lambert", "albedo": "wood.png"}
    rest = {"hdr_output_file": "", "output_buffers": []}
    a = write_scene(tmp_path / "a.json", output_file="wood.png", **rest)
    b = write_scene(tmp_path / "b.json", output_file="b.png", **rest)
    b.write_text(json.dumps({**json.loads(b.read_text()), "bsdfs": [bsdf]}))
    before = (tmp_path / "wood.png").read_bytes()
    scenes = {"a": str(a), "b": str(b)}
    assert tungsten.main([scenes[name] for name in names]) == 2
    assert (tmp_path / "wood.png").read_bytes() == before
    assert (tmp_path / "b.png").exists()
    assert "wood.png" in capfd.readouterr().err


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
@pytest.mark.parametrize("overwrite", [True, False])
def test_names_that_no_file_can_have_are_one_line(field, overwrite, name, tmp_path, renders, capfd):
    suffix = {"output_file": ".png", "hdr_output_file": ".exr", "output_directory": ""}[field]
    names = {field: name + suffix, "overwrite_output_files": overwrite}
    scene = write_scene(tmp_path / "scene.json", **names)
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
            assert models.alone is None

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
    ("error", "line"),
    [
        (InputError("a.json: cannot be rendered"), "a.json: cannot be rendered"),
        (
            MemoryError("std::bad_alloc"),
            "not enough memory (std::bad_alloc); free some, or use a smaller image",
        ),
    ],
)
def test_a_render_that_fails_does_not_keep_the_next_one_from_being_denoised(
    error, line, tmp_path, renders, capfd, monkeypatch
):
    render = tungsten.render_with_mitsuba

    def failing_at_first(scene, **options):
        if scene.path.name == "a.json":
            raise error
        return render(scene, **options)

    monkeypatch.setattr("tungsten_dip.cli.tungsten.render_with_mitsuba", failing_at_first)
    scenes = write_frames(tmp_path, "a", "b")
    assert tungsten.main(["--dip-denoise", "--dip-preset", "draft", *map(str, scenes)]) == 2
    lines = capfd.readouterr().err.splitlines()
    assert f"tungsten: {line}" in lines
    assert lines[-1] == "tungsten: 1 of 2 scenes failed, see above"
    assert {path.name for path in tmp_path.glob("*.exr")} == {"b.exr", "b_denoised.exr"}


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
        ("-i {tmp}/none {scene}", ["-i {tmp}/none: no such folder"]),
        ("-i {scene} {scene}", ["-i {scene}: no such folder"]),
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


def test_an_output_directory_that_is_a_file_is_refused(tmp_path, scene, capfd):
    (tmp_path / "out").touch()
    assert tungsten.main(["--dip-denoise", "-d", str(tmp_path / "out"), str(scene)]) == 2
    assert f"{tmp_path / 'out'}: expected a folder, found a file" in capfd.readouterr().err


def test_torch_is_missed_before_the_render(tmp_path, scene, monkeypatch, capfd):
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: None)
    assert (
        tungsten.main(["--dip-denoise", "--dip-preset", "paper", "-d", str(tmp_path / "out"), str(scene)])
        == 2
    )
    captured = capfd.readouterr()
    assert "pip install 'tungsten-dip[paper]'" in captured.err
    assert "Traceback" not in captured.err
    assert not (tmp_path / "out").exists()


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
        preview(tungsten.tungsten_host.Rendered(render.buffers, None, "gamma"))
    assert (tmp_path / "room_preview.png").exists()


@pytest.mark.parametrize("interrupted", [False, True])
def test_ctrl_c_and_a_failed_preview_lose_no_file_of_the_render(
    interrupted, tmp_path, render, monkeypatch, capfd
):
    def drive(path, options, on_checkpoint, progress):
        failure = InputError("no preview")
        return tungsten.tungsten_host.Rendered(render.buffers, None, "gamma", interrupted, failure)

    monkeypatch.setattr(tungsten.tungsten_host, "in_process", lambda: True)
    monkeypatch.setattr(tungsten.tungsten_host, "drive", drive)
    scene = write_scene(tmp_path / "scene.json", hdr_output_file="room.exr")
    options = ["--host", "tungsten", "--dip-denoise", "--dip-preview", "-d", str(tmp_path), str(scene)]
    assert tungsten.main(options) == (130 if interrupted else 2)
    assert ("no preview" in capfd.readouterr().err) != interrupted
    assert (tmp_path / "room.exr").exists()


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


def test_what_follows_two_dashes_are_scenes(tmp_path, renders, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_frames(tmp_path, "one", "-x")
    for arguments in (["--", "-x.json"], ["-t", "1", "one.json", "--", "-x.json"]):
        assert tungsten.main(arguments) == 0
        assert (tmp_path / "-x.png").exists()
        (tmp_path / "-x.png").unlink()
    assert (tmp_path / "one.png").exists()


def test_the_native_command_takes_no_scene_for_an_option(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run_native(arguments):
        raise InputError(f"run: {arguments}")

    monkeypatch.setattr(tungsten, "_run_native", run_native)
    with pytest.raises(InputError, match=re.escape(str(["-t", "1", str(tmp_path / "-x.json")]))):
        tungsten._run(["--host", "tungsten", "-t", "1", "--", "-x.json"])


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
