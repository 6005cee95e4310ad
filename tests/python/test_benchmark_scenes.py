"""The scenes that benchmarks/scenes.py writes, and what the other scripts there refuse."""

import subprocess
import sys
from pathlib import Path

import pytest

from tungsten_dip.scene.parse import load_scene

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def write_scenes(folder, *options):
    return subprocess.run(
        [sys.executable, BENCHMARKS / "scenes.py", folder, *options],
        capture_output=True,
        text=True,
        check=False,
    )


def test_every_frame_of_every_scene_can_be_read(tmp_path):
    assert write_scenes(tmp_path, "--frames", "2").returncode == 0
    files = sorted(tmp_path.glob("*/*.json"))
    assert {file.name for file in files} == {
        f"{what}-000{frame}.json" for what in ("noisy", "reference") for frame in (0, 1)
    }
    assert len({load_scene(file).path.parent for file in files}) == len(files) // 4 == 12


@pytest.mark.parametrize("frames", ["0", "-1"])
def test_no_frames_are_refused_in_one_line(tmp_path, frames):
    result = write_scenes(tmp_path / "scenes", f"--frames={frames}")
    assert result.returncode == 1
    assert result.stderr.endswith(f"--frames: expected a number above 0, got {frames}\n")
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "scenes").exists()


def test_costs_of_no_repeats_are_refused_in_one_line():
    script = [sys.executable, BENCHMARKS / "effect_costs.py", "--repeats", "0"]
    result = subprocess.run(script, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert result.stderr.endswith("effect_costs.py: --repeats: expected 1 or more, got 0\n")
    assert result.stderr.count("\n") == 1
