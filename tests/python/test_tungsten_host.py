"""The hook in the real Tungsten, against the stock command of the same build.

Runs where the package was built against a Tungsten and Tungsten_ROOT and Tungsten_BUILD name it.
"""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tungsten_dip import hosts
from tungsten_dip.buffers.image_file import write_image
from tungsten_dip.buffers.read import read_image
from tungsten_dip.cli.tungsten import main
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitSettings
from tungsten_dip.fit.result import FitResult
from tungsten_dip.hosts import memory, native, tungsten
from tungsten_dip.scene.parse import load_scene

ROOT, BUILD = os.environ.get("Tungsten_ROOT"), os.environ.get("Tungsten_BUILD")  # noqa: SIM112
pytestmark = [
    pytest.mark.skipif(
        not (ROOT and BUILD), reason="Tungsten_ROOT and Tungsten_BUILD do not name a Tungsten"
    ),
    pytest.mark.skipif(not tungsten.available(), reason="the package was built without a Tungsten"),
]
in_process = pytest.mark.skipif(
    not tungsten.in_process(), reason="Tungsten's libraries are not position-independent"
)

QUANTITIES = ("color", "albedo", "normal", "depth", "visibility")
SUFFIXES = {"mean": "", "half_a": "A", "half_b": "B", "variance": "Variance"}


@pytest.fixture
def write_scene(tmp_path):
    """``write_scene(**renderer)``: a lit, bumpy corner of 40x24 pixels, its file in a folder of its own."""

    def write(integrator="path_tracer", camera=(), **renderer):
        path = tmp_path / "scene" / f"scene{len(list(tmp_path.glob('scene/*')))}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(_scene(integrator, dict(camera), renderer)))
        return path

    return write


def _scene(integrator, camera, renderer):
    def quad(position, rotation, scale, bsdf, **more):
        transform = {"position": position, "rotation": rotation, "scale": scale}
        return {"type": "quad", "transform": transform, "bsdf": bsdf, **more}

    checker = {"type": "checker", "on_color": [0.8, 0.5, 0.2], "off_color": 0.1, "res_u": 8, "res_v": 8}
    return {
        "bsdfs": [
            {"name": "floor", "type": "lambert", "albedo": checker},
            {"name": "wall", "type": "rough_conductor", "material": "Cu", "roughness": 0.3, "albedo": 1.0},
            {"name": "glass", "type": "dielectric", "ior": 1.5, "albedo": 1.0},
            {"name": "light", "type": "null", "albedo": 1.0},
        ],
        "primitives": [
            quad([0, 0, 0], [0, 0, 0], [4, 1, 4], "floor"),
            quad([0, 2, -2], [90, 0, 0], [4, 1, 4], "wall"),
            quad([0, 3, 0], [180, 0, 0], [0.7, 1, 0.7], "light", emission=[12, 10, 8]),
            {"type": "sphere", "transform": {"position": [0.5, 0.5, 0.4], "scale": 0.5}, "bsdf": "glass"},
        ],
        "camera": {
            "type": "pinhole",
            "fov": 50,
            "tonemap": "filmic",
            "resolution": [40, 24],
            "transform": {"position": [0, 1.2, 4], "look_at": [0, 0.9, 0], "up": [0, 1, 0]},
            **camera,
        },
        "integrator": {"type": integrator, "max_bounces": 8},
        "renderer": {
            "output_file": "picture.png",
            "hdr_output_file": "picture.pfm",
            "adaptive_sampling": False,
            "spp": 8,
            "spp_step": 4,
            **renderer,
        },
    }


def _run(command, scene, folder, threads="2"):
    folder.mkdir()
    arguments = [command, "-t", threads, "-s", "5", "-d", folder, scene]
    subprocess.run(arguments, capture_output=True, text=True, check=True)
    return folder


def _stock(scene, folder, threads="2"):
    return _run(Path(BUILD) / "tungsten", scene, folder, threads)


def _output_buffers(**settings):
    return [{"type": name, "hdr_output_file": f"{name}.pfm", **settings} for name in QUANTITIES]


def _files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    "scene",
    [
        {},
        {"adaptive_sampling": True, "spp": 40, "output_buffers": _output_buffers(sample_variance=True)},
        {"integrator": "bidirectional_path_tracer", "stratified_sampler": False},
    ],
    ids=["sobol", "adaptive-with-buffers", "bidirectional"],
)
def test_command_without_dip_flags_writes_the_bytes_of_the_stock_command(write_scene, tmp_path, scene):
    path = write_scene(**scene)
    # Splats from several threads add up in the order in which they come: one thread there.
    threads = "1" if "integrator" in scene else "2"
    stock = _stock(path, tmp_path / "stock", threads)
    ours = _run(native.executable(), path, tmp_path / "ours", threads)
    assert len(_files(stock)) >= 2
    assert _files(ours) == _files(stock)


def test_command_without_dip_flags_fails_where_a_scene_fails(write_scene, tmp_path):
    broken = tmp_path / "broken.json"
    broken.write_text("{")
    result = subprocess.run(
        [native.executable(), "-d", tmp_path / "out", broken, write_scene()],
        capture_output=True,
        check=False,
    )
    assert result.returncode == 1
    assert (tmp_path / "out" / "picture.png").exists()


@pytest.mark.parametrize("adaptive", [False, True])
def test_buffers_equal_the_files_of_the_stock_command(write_scene, tmp_path, adaptive):
    settings = {"adaptive_sampling": adaptive, "stratified_sampler": False, "spp": 40, "spp_step": 8}
    both = _output_buffers(two_buffer_variance=True, sample_variance=True)
    files = _stock(write_scene(**settings, output_buffers=both), tmp_path / "stock")
    buffers = tungsten.render(write_scene(**settings), seed=5, threads=2)

    assert np.ndim(buffers.spp) == (3 if adaptive else 0)
    assert np.mean(buffers.spp) == pytest.approx(40, rel=0.05)
    for name in QUANTITIES:
        for plane, array in getattr(buffers, name).planes():
            stored = read_image(files / f"{name}{SUFFIXES[plane]}.pfm").reshape(24, 40, -1)[
                ..., : array.shape[2]
            ]
            # Without a sample Tungsten's variance is 0/0; ours is 0.
            np.testing.assert_allclose(
                array, np.nan_to_num(stored, nan=0.0), rtol=1e-6, err_msg=f"{name} {plane}"
            )


def test_halves_are_independent_though_the_scene_asks_for_the_stratified_sampler(write_scene):
    path = write_scene(stratified_sampler=True)
    renders = [tungsten.render(path, seed=seed, threads=2).color for seed in range(24)]
    # The logarithm keeps fireflies from deciding; what is independent stays so under any function.
    a, b = (
        np.log1p(20 * np.array([getattr(r, half) for r in renders], np.float64))
        for half in ("half_a", "half_b")
    )
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    assert abs((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum())) < 0.03


@in_process
def test_arrays_are_tungstens_own_memory_and_outlive_the_render(write_scene):
    buffers = tungsten.render(write_scene(), threads=1)
    kept, before = buffers.color.half_b, buffers.color.half_b.copy()
    assert not kept.flags.owndata
    assert kept.flags.writeable
    del buffers
    tungsten.render(write_scene(), seed=1, threads=1)
    np.testing.assert_array_equal(kept, before)


@in_process
def test_going_through_the_native_command_gives_the_same_buffers(write_scene, monkeypatch):
    path, seen = write_scene(adaptive_sampling=True, spp=40), []
    direct = tungsten.render(path, seed=3, threads=2)
    monkeypatch.setattr(tungsten, "_module", lambda: None)
    through = tungsten.render(
        path, seed=3, threads=2, progress=lambda fraction, message: seen.append(fraction)
    )
    assert seen == sorted(seen)
    assert seen[-1] == 1
    assert through.attributes == direct.attributes
    np.testing.assert_array_equal(through.spp, direct.spp)
    for name, buffer in direct.quantities():
        for plane, array in buffer.planes():
            np.testing.assert_array_equal(getattr(getattr(through, name), plane), array)


@pytest.mark.parametrize("through_command", [False, True])
def test_files_are_looked_for_where_the_scene_was_read_with_them(
    write_scene, tmp_path, monkeypatch, through_command
):
    if through_command:
        monkeypatch.setattr(tungsten, "_module", lambda: None)
    elif not tungsten.in_process():
        pytest.skip("Tungsten's libraries are not position-independent")
    path, textures = write_scene(), tmp_path / "textures"
    scene = json.loads(path.read_text())
    scene["bsdfs"][0]["albedo"] = scene["bsdfs"][1]["albedo"] = "color.pfm"
    path.write_text(json.dumps(scene))
    textures.mkdir()
    write_image(textures / "color.pfm", np.full((2, 2, 3), (0.125, 0.25, 0.5), np.float32))
    albedo = hosts.render(load_scene(path, textures), host="tungsten", spp=2, seed=1).albedo.mean
    np.testing.assert_array_equal(albedo[-1], np.tile(np.float32([0.125, 0.25, 0.5]), (40, 1)))


@pytest.mark.parametrize("through_command", [False, True])
def test_a_scene_that_cannot_be_loaded_is_one_line(write_scene, tmp_path, monkeypatch, through_command):
    if through_command:
        monkeypatch.setattr(tungsten, "_module", lambda: None)
    elif not tungsten.in_process():
        pytest.skip("Tungsten's libraries are not position-independent")
    unknown = json.loads(write_scene().read_text())
    unknown["bsdfs"][0]["type"] = "velvet"
    for content in ("{", json.dumps(unknown)):
        path = tmp_path / "broken.json"
        path.write_text(content)
        with pytest.raises(InputError) as error:
            tungsten.render(path)
        assert str(path) in str(error.value)
        assert "check" in str(error.value)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="found none"):
        tungsten.render(tmp_path / "missing.json")
    with pytest.raises(InputError, match="spp"):
        tungsten.render(write_scene(), spp=0)


@in_process
def test_a_picture_that_does_not_fit_into_memory_is_refused(write_scene, monkeypatch):
    path = write_scene(camera={"resolution": [65536, 65536]})  # as 32 bits count: none
    with pytest.raises(InputError, match="got 65536 x 65536; lower the resolution"):
        tungsten.render(path)
    monkeypatch.setattr(memory, "_available_bytes", lambda: 959 * 240)
    with pytest.raises(InputError, match=r"expected at most 959 pixels, .* got 40 x 24"):
        tungsten.render(write_scene())


@in_process
def test_one_sample_per_pixel_has_no_halves(write_scene, caplog):
    buffers = tungsten.render(write_scene(), spp=1, threads=1)
    assert [name for name, _ in buffers.color.planes()] == ["mean"]
    assert "render at least 2" in caplog.text


@in_process
def test_other_integrators_give_colour_alone_and_say_so(write_scene, tmp_path, caplog):
    path = write_scene(integrator="bidirectional_path_tracer", stratified_sampler=False)
    with caplog.at_level(logging.INFO):
        buffers = tungsten.render(path, seed=5, threads=1)
    assert [name for name, _ in buffers.quantities()] == ["color"]
    assert buffers.color.halves is None
    assert "bidirectional_path_tracer writes no feature buffers" in caplog.text
    picture = read_image(_stock(path, tmp_path / "stock", "1") / "picture.pfm")
    assert buffers.color.mean.mean() == pytest.approx(picture.mean(), rel=1e-4)


@in_process
def test_odd_sizes(write_scene):
    for size in ([1, 1], [17, 3]):
        buffers = tungsten.render(write_scene(camera={"resolution": size}), threads=2)
        assert buffers.color.mean.shape == (size[1], size[0], 3)
        assert np.isfinite(buffers.color.variance).all()


@in_process
def test_driving_leaves_the_scene_and_its_own_outputs_as_they_are(write_scene, tmp_path):
    own = [{"type": "albedo", "hdr_output_file": "own.pfm"}]
    settings = {"stratified_sampler": False, "output_buffers": own}
    path = write_scene(**settings)
    before = path.read_bytes()
    stock = _stock(path, tmp_path / "stock")
    ours = tmp_path / "ours"
    rendered = tungsten.drive(path, tungsten.DriverOptions(seed=5, threads=2, output_directory=ours))

    assert path.read_bytes() == before
    assert {file.name for file in ours.iterdir()} == {file.name for file in stock.iterdir()}
    assert rendered.output_file == ours / "picture.png"
    assert rendered.tonemap == "filmic"
    for name in ("own.pfm", "picture.pfm"):
        np.testing.assert_allclose(read_image(ours / name), read_image(stock / name), rtol=1e-5, atol=1e-6)
    assert rendered.buffers.albedo.halves is not None


@in_process
def test_a_saved_state_is_resumed(write_scene, tmp_path, caplog):
    path = write_scene(enable_resume_render=True, checkpoint_interval="0", spp=4)
    options = tungsten.DriverOptions(seed=5, threads=2, output_directory=tmp_path / "out")
    tungsten.drive(path, options)
    assert (tmp_path / "out" / "TungstenRenderState_dip.dat").exists()
    longer = tungsten.DriverOptions(seed=5, threads=2, output_directory=tmp_path / "out", spp=12)
    with caplog.at_level(logging.INFO):
        resumed = tungsten.drive(path, longer).buffers
    assert "resuming at 4 spp" in caplog.text
    whole = tungsten.render(path, spp=12, seed=5, threads=2)
    np.testing.assert_array_equal(resumed.color.half_a, whole.color.half_a)
    np.testing.assert_array_equal(resumed.albedo.variance, whole.albedo.variance)

    state = tmp_path / "out" / "TungstenRenderState_dip.dat"
    state.write_bytes(state.read_bytes()[:-100])
    with pytest.raises(InputError, match="cut short; delete it"):
        tungsten.drive(path, longer)
    state.write_bytes(np.random.default_rng(1).bytes(5000))
    with pytest.raises(InputError, match=r"saved state cannot be read: .*; delete it"):
        tungsten.drive(path, longer)


@in_process
def test_checkpoints_are_previewed_and_a_failing_preview_does_not_stop_the_render(
    write_scene, tmp_path, caplog
):
    options = tungsten.DriverOptions(
        threads=2, spp=16, checkpoint_interval_s=1e-9, output_directory=tmp_path / "out"
    )
    seen = []

    def preview(rendered):
        seen.append(rendered.buffers)
        if len(seen) == 2:
            raise ValueError("no preview")

    rendered = tungsten.drive(write_scene(), options, on_checkpoint=preview)
    assert str(rendered.failure) == "no preview"
    assert [buffers.spp for buffers in seen] == [4, 8]
    assert seen[0].color.half_a.flags.writeable
    assert "the render goes on without" in caplog.text
    assert {"picture.png", "picture_checkpoint.png"} <= {file.name for file in (tmp_path / "out").iterdir()}


@in_process
def test_ctrl_c_in_a_preview_ends_the_render_with_what_there_is(write_scene, tmp_path):
    def preview(rendered):
        raise KeyboardInterrupt

    options = tungsten.DriverOptions(spp=16, checkpoint_interval_s=1e-9, output_directory=tmp_path)
    rendered = tungsten.drive(write_scene(), options, on_checkpoint=preview)
    assert rendered.interrupted
    assert rendered.buffers.spp == 4
    assert (tmp_path / "picture.png").exists()


@in_process
def test_the_command_denoises_and_previews_beside_the_renders_own_files(write_scene, tmp_path, monkeypatch):
    def fit(buffers, settings, warm_start=None):
        asked.append((settings.preset, buffers.spp))
        return FitResult(color=buffers.color.mean, settings=settings, seconds=0.0, iterations=0)

    asked = []
    monkeypatch.setattr("tungsten_dip.cli.tungsten.denoise_with_progress", fit)
    out = tmp_path / "out"
    flags = [
        "--host",
        "tungsten",
        "-t",
        "2",
        "--spp",
        "8",
        "-c",
        "0.000001s",
        "--dip-denoise",
        "--dip-preview",
    ]
    assert main([*flags, "-d", str(out), str(write_scene(hdr_output_file="picture.exr"))]) == 0
    assert asked == [("draft", 4), ("balanced", 8)]
    names = (
        "picture.png",
        "picture.exr",
        "picture_denoised.exr",
        "picture_denoised.png",
        "picture_preview.png",
    )
    for name in names:
        assert (out / name).stat().st_size > 0, name


@in_process
@pytest.mark.parametrize("interrupted", [False, True])
def test_exr_files_are_written_whether_or_not_tungsten_can(write_scene, tmp_path, monkeypatch, interrupted):
    def drive(*arguments):
        return replace(original(*arguments), interrupted=interrupted)

    original = tungsten.drive
    monkeypatch.setattr(tungsten, "drive", drive)
    fit = FitResult(np.zeros((24, 40, 3), np.float32), FitSettings(), seconds=0.0, iterations=0)
    monkeypatch.setattr("tungsten_dip.cli.tungsten.denoise_with_progress", lambda *_: fit)
    own = [
        {"type": "albedo", "hdr_output_file": "own.exr", "two_buffer_variance": True},
        {"type": "normal", "hdr_output_file": "normal.pfm"},
    ]
    scene = write_scene(hdr_output_file="picture.exr", output_buffers=own)
    arguments = ["--host", "tungsten", "--dip-denoise", "-d", str(tmp_path / "out"), str(scene)]
    assert main(arguments) == (130 if interrupted else 0)
    for name in ("picture.exr", "own.exr", "ownA.exr", "ownB.exr", "normal.pfm"):
        assert read_image(tmp_path / "out" / name).any(), name


@in_process
def test_tungsten_writes_its_pictures_under_the_names_of_the_denoised_ones(
    write_scene, tmp_path, monkeypatch
):
    def fit(buffers, settings, warm_start=None):
        return FitResult(color=buffers.color.mean, settings=settings, seconds=0.0, iterations=0)

    monkeypatch.setattr("tungsten_dip.cli.tungsten.denoise_with_progress", fit)
    monkeypatch.chdir(tmp_path)
    # Tungsten writes no JPEG, and would number each picture by itself.
    arguments = ["--host", "tungsten", "--dip-denoise", "-d", "out"]
    arguments.append(str(write_scene(overwrite_output_files=False, output_file="a.jpg")))
    names = ("a{}.png", "picture{}.pfm", "a{}_denoised.exr", "a{}_denoised.png", "a{}_side_by_side.png")
    for number in ("", "001"):
        assert main(arguments) == 0
        written = {path.name for path in Path("out").iterdir()}
        assert {name.format(number) for name in names} <= written
        (tmp_path / "out" / "a.png").unlink(missing_ok=True)
    assert "a.png" not in written


@in_process
def test_interrupting_saves_the_outputs_of_the_passes_so_far(write_scene, tmp_path, caplog):
    path = write_scene(camera={"resolution": [80, 48]}, spp=100_000, spp_step=8)
    options = tungsten.DriverOptions(threads=2, output_directory=tmp_path / "out")
    started = threading.Event()

    def interrupt():
        started.wait()
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    handler = signal.getsignal(signal.SIGINT)
    rendered = tungsten.drive(
        path, options, progress=lambda fraction, _: started.set() if fraction > 0 else None
    )
    thread.join()
    assert rendered.interrupted
    assert signal.getsignal(signal.SIGINT) is handler
    assert read_image(tmp_path / "out" / "picture.pfm").mean() > 0


@in_process
def test_python_runs_on_while_tungsten_renders(write_scene):
    path = write_scene(camera={"resolution": [160, 96]}, spp=64, spp_step=64)
    fractions = []
    worker = threading.Thread(
        target=tungsten.render,
        args=(path,),
        kwargs={"threads": 1, "progress": lambda f, _: fractions.append(f)},
    )
    worker.start()
    turns = 0
    while worker.is_alive():
        if fractions == [0.0]:  # inside the only pass
            turns += 1
        worker.join(0.01)
    assert fractions == [0.0, 1.0]
    assert turns > 1


def test_the_native_command_runs_the_package_and_fails_in_one_line(tmp_path):
    result = subprocess.run(
        [native.executable(), "--dip-denoise", tmp_path / "missing.json"],
        env={**os.environ, "TUNGSTEN_DIP_PYTHON": sys.executable},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2
    assert "missing.json" in result.stderr
    assert "Traceback" not in result.stderr


def test_the_native_command_names_what_chooses_its_python(tmp_path):
    result = subprocess.run(
        [native.executable(), "--dip-denoise", tmp_path / "missing.json"],
        env={**os.environ, "TUNGSTEN_DIP_PYTHON": str(tmp_path / "python")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "environment variable TUNGSTEN_DIP_PYTHON" in result.stderr


def test_the_native_command_runs_no_code_beside_the_scene(tmp_path):
    for module in ("json", "logging"):
        (tmp_path / f"{module}.py").write_text("open('ran', 'w')")
    result = subprocess.run(
        [native.executable(), "--dip-denoise", "missing.json"],
        cwd=tmp_path,
        env={**os.environ, "TUNGSTEN_DIP_PYTHON": sys.executable},
        capture_output=True,
        text=True,
        check=False,
    )
    assert not (tmp_path / "ran").exists()
    assert result.returncode == 2
    assert "missing.json" in result.stderr


@in_process
def test_buffers_that_are_taken_are_gone(write_scene):
    session = tungsten._load(write_scene(), tungsten.DriverOptions(spp=1))
    session.take_buffers()
    for again in (session.take_buffers, session.buffers):
        with pytest.raises(RuntimeError):
            again()
