"""The scripts of benchmarks/ run on a tiny image: they replace private parts of a fit, which may change."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from synthetic import synthetic_render
from tungsten_dip.buffers.image_file import write_image
from tungsten_dip.buffers.write import write_tungsten_folder

SCRIPTS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def rows(monkeypatch, capsys):
    """``rows(script, *arguments)``: the cells of the table that a script prints, without its header."""

    def run(script, *arguments):
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        runpy.run_path(str(SCRIPTS / script))["main"]()
        lines = capsys.readouterr().out.splitlines()
        return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]

    return run


@pytest.fixture
def room(tmp_path):
    render = synthetic_render(16, 24)
    write_tungsten_folder(tmp_path / "room", render.buffers)
    write_image(tmp_path / "room" / "reference.exr", render.reference)
    return tmp_path / "room"


def test_ablation(rows, room):
    pytest.importorskip("flip_evaluator")
    found = rows("ablation.py", "--threads", 1, room)
    assert found[0][0] == "balanced"
    # Every variant changes the image, except one on an image without empty space.
    same = [name for name, metrics, _ in found[1:] if metrics == found[0][1]]
    assert same in ([], ["empty space like any other"])


def test_calibration(rows, room):
    ((_, error, true, estimated, ratio, rank),) = rows(
        "calibration.py", "--spp-ratio", 0.01, "--preset", "draft", room
    )
    assert 0 < float(true) < float(error)
    assert float(ratio) == pytest.approx(float(estimated) / float(true), abs=0.02)
    assert -1 <= float(rank) <= 1


def test_sizes(rows, room):
    ((size, seconds, microseconds, gib),) = rows("sizes.py", "--preset", "draft", room, "30x20")
    assert size == "30x20"
    assert float(microseconds) == pytest.approx(1e6 * float(seconds) / (30 * 20), rel=0.01)
    assert 0.02 < float(gib) < 4


def test_stopping(rows, room):
    found = rows("stopping.py", room)
    assert [name.split(",")[0] for name, _ in found] == ["draft", "balanced"]
    for _, cell in found:
        last, above = cell.rstrip(")").split(" (")
        assert float(last) > 0
        assert float(above) >= 0


def test_frames(rows, tmp_path):
    pytest.importorskip("flip_evaluator")
    rng = np.random.default_rng(0)
    for number in (1, 2):
        frame = rng.random((16, 24, 3), np.float32)
        write_image(tmp_path / f"reference{number}.exr", frame)
        write_image(tmp_path / f"brighter{number}.exr", frame + np.float32(0.1))
    same, brighter = rows(
        "frames.py", *(tmp_path / f"{name}#.exr" for name in ("reference", "reference", "brighter"))
    )
    assert same[1:] == ["inf", "0.00000", "0.0000", "0.00000"]
    assert float(brighter[2]) > 0
    # The error of both frames is the same, so nothing of it flickers.
    assert float(brighter[4]) == pytest.approx(0, abs=1e-5)
