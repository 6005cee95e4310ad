"""Which host renders, and that a scene file goes through it."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tungsten_dip import hosts
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.errors import InputError
from tungsten_dip.hosts import memory, tungsten
from tungsten_dip.hosts.mitsuba.render import render
from tungsten_dip.scene.parse import load_scene


@pytest.fixture
def scene_path(tmp_path: Path) -> Path:
    """A gray floor seen from above, under a white sky."""
    scene = {
        "bsdfs": [{"name": "gray", "type": "lambert", "albedo": 0.5}],
        "primitives": [
            {"type": "quad", "bsdf": "gray", "transform": {"scale": 9}},
            {"type": "infinite_sphere", "emission": 1},
        ],
        "camera": {
            "type": "pinhole",
            "resolution": [5, 3],
            "fov": 40,
            "transform": {"position": [0, 2, 0], "look_at": [0, 0, 0], "up": [0, 0, 1]},
        },
        "integrator": {"type": "path_tracer"},
        "renderer": {"spp": 16},
    }
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(scene))
    return path


def test_mitsuba_renders_a_scene_file(scene_path: Path) -> None:
    buffers = hosts.render(scene_path, host="mitsuba")
    assert (buffers.width, buffers.height, buffers.spp) == (5, 3, 16)
    assert buffers.albedo is not None
    np.testing.assert_allclose(buffers.albedo.mean, 0.5, rtol=1e-5)
    assert buffers.color.mean.mean() == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(("has_tungsten", "expected"), [(True, "Tungsten"), (False, "Mitsuba")])
def test_auto_prefers_tungsten_and_says_who_renders(
    has_tungsten: bool,
    expected: str,
    scene_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    asked = []

    def render_with_tungsten(path: Path, **options: Any) -> RenderBuffers:
        asked.append((path, options["spp"]))
        return RenderBuffers(Buffer(np.zeros((3, 5, 3), np.float32)))

    monkeypatch.setattr(tungsten, "available", lambda: has_tungsten)
    monkeypatch.setattr(tungsten, "render", render_with_tungsten)
    with caplog.at_level(logging.INFO):
        hosts.render(scene_path, spp=2)
    assert f"rendered by {expected}" in caplog.text
    assert asked == ([(scene_path, 2)] if has_tungsten else [])


def test_a_hook_that_cannot_be_loaded_is_told_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(name: str) -> Any:
        raise ImportError(f"{name}: undefined symbol")

    monkeypatch.setattr(tungsten.importlib, "import_module", fail)
    tungsten._module.cache_clear()
    try:
        for _ in range(2):
            assert not tungsten.in_process()
    finally:
        tungsten._module.cache_clear()
    assert caplog.text.count("the hook for Tungsten cannot be loaded: tungsten_dip._tungsten: undef") == 1


def test_tungsten_reads_the_scene_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scene.json"
    path.write_text('{"primitives": [{"type": "mesh", "file": "of a fork.abc"}]}')
    monkeypatch.setattr(tungsten, "available", lambda: True)
    monkeypatch.setattr(tungsten, "render", lambda path, **_: path)
    assert hosts.render(path) == path
    with pytest.raises(InputError, match="expected a file"):
        hosts.render(path, host="mitsuba")


@pytest.mark.parametrize("folder", [None, "elsewhere"])
def test_tungsten_looks_for_files_where_the_scene_was_read_with_them(
    folder: str | None, scene_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    input_directory = folder and scene_path.parent / folder
    monkeypatch.setattr(tungsten, "render", lambda path, **options: (path, options["input_directory"]))
    rendered: Any = hosts.render(load_scene(scene_path, input_directory), host="tungsten")
    assert rendered == (scene_path, input_directory)


def test_a_picture_that_does_not_fit_into_memory_is_refused(
    scene_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = load_scene(scene_path)
    monkeypatch.setattr(memory, "_available_bytes", lambda: 15 * 1000)
    hosts.render(scene, host="mitsuba", spp=1)  # 5 x 3 pixels of less than 1000 bytes
    monkeypatch.setattr(memory, "_available_bytes", lambda: 15 * 4 * 34)
    with pytest.raises(InputError, match=f"{scene_path}: expected at most 3 pixels, .* got 5 x 3; lower"):
        hosts.render(scene, host="mitsuba", spp=1)


def test_colour_alone_takes_less_memory(scene_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(scene_path)
    monkeypatch.setattr(memory, "_available_bytes", lambda: 15 * 400)
    memory.check_fits_mitsuba(scene, ["color"])
    with pytest.raises(InputError, match="lower the resolution"):
        memory.check_fits_mitsuba(scene, ["color", "albedo", "normal", "depth"])


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="the system does not tell its memory")
def test_available_memory_is_a_part_of_the_whole() -> None:
    available = memory._available_bytes()
    assert available is not None
    assert 0 < available < os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ({}, 8 << 20),
        ({"": "max", "pod": "max", "pod/job": "max"}, 8 << 20),
        ({"": str(5 << 20)}, 3 << 20),
        ({"pod": str(5 << 20), "pod/job": "max"}, 3 << 20),
        ({"pod": str(6 << 20), "pod/job": str(5 << 20)}, 3 << 20),
        ({"pod/job": str(100 << 20)}, 8 << 20),
        ({"pod/job": str(1 << 20)}, 0),
        ({"other": str(1 << 20)}, 8 << 20),
    ],
)
def test_available_memory_is_no_more_than_a_container_has(
    limits: dict[str, str], expected: int, tmp_path: Path
) -> None:
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/meminfo").write_text(f"MemTotal: 16384 kB\nMemAvailable: {8 << 10} kB\n")
    (tmp_path / "proc/self/cgroup").write_text("1:cpu:/other\n0::/pod/job\n")
    for group, limit in limits.items():
        folder = tmp_path / "sys/fs/cgroup" / group
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "memory.max").write_text(f"{limit}\n")
        (folder / "memory.current").write_text(f"{3 << 20}\n")
        (folder / "memory.stat").write_text(f"anon 5\ninactive_file {1 << 19}\nactive_file {1 << 19}\n")
    assert memory._available_bytes(tmp_path) == expected


def test_available_memory_is_unknown_where_the_system_does_not_tell(tmp_path: Path) -> None:
    assert memory._available_bytes(tmp_path) is None


@pytest.mark.parametrize("quantities", [("depth",), ("color", "albdo")])
def test_unknown_quantities_are_told_before_memory_is(quantities: Any, scene_path: Path) -> None:
    found = ", ".join(quantities)
    with pytest.raises(InputError, match=rf"quantities: expected color and others of .*, got {found}"):
        render(load_scene(scene_path), quantities=quantities)


@pytest.mark.parametrize("name", ["spp", "seed", "threads"])
@pytest.mark.parametrize("value", [1.5, "4", -1, 2**40])
def test_numbers_that_no_host_can_take_are_told(name: str, value: Any, scene_path: Path) -> None:
    message = f"{name}: expected a whole number from . to .*, got "
    with pytest.raises(InputError, match=message):
        hosts.render(scene_path, host="mitsuba", **{name: value})
    with pytest.raises(InputError, match=message):
        tungsten.render(scene_path, **{name: value})


def test_numbers_of_numpy_are_numbers_to_every_host(scene_path: Path) -> None:
    one = np.int64(1)
    buffers = hosts.render(scene_path, host="mitsuba", spp=one, seed=one, threads=one)  # type: ignore[arg-type]
    assert buffers.spp == 1
    options = tungsten.DriverOptions(spp=one, seed=one, threads=one)  # type: ignore[arg-type]
    assert {type(value) for value in (options.spp, options.seed, options.threads)} == {int}


def test_unknown_host(scene_path: Path) -> None:
    for host in ("blender", np.zeros(3)):
        with pytest.raises(InputError, match=r"host: expected auto, tungsten, mitsuba, got ('b|a)"):
            hosts.render(scene_path, host=host)  # type: ignore[arg-type]
