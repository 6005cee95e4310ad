"""The scenes that benchmarks/scenes.py writes."""

import subprocess
import sys
from pathlib import Path

import pytest

from tungsten_dip.scene import load_scene

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "scenes.py"


def write_scenes(folder, *options):
    return subprocess.run(
        [sys.executable, SCRIPT, folder, *options], capture_output=True, text=True, check=False
    )


def test_every_frame_of_every_scene_can_be_read(tmp_path):
    assert write_scenes(tmp_path, "--frames", "2").returncode == 0
    files = sorted(tmp_path.glob("*/*.json"))
    assert {file.name for file in files} == {
        f"{what}-000{frame}.json" for what in ("noisy", "reference") for frame in (0, 1)
    }
    assert len({load_scene(file).path.parent for file in files}) == len(files) // 4 == 7


@pytest.mark.parametrize("frames", ["0", "-1"])
def test_no_frames_are_refused_in_one_line(tmp_path, frames):
    result = write_scenes(tmp_path / "scenes", f"--frames={frames}")
    assert result.returncode == 1
    assert result.stderr.endswith(f"--frames: expected a number above 0, got {frames}\n")
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "scenes").exists()
