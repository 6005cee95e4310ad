"""The goals of the Makefile that no other test needs."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_clean_removes_all_that_was_built_and_nothing_else(tmp_path: Path) -> None:
    package = tmp_path / "python" / "tungsten_dip"
    kept = [package / "errors.py", tmp_path / "tests" / "test_errors.py", tmp_path / "Makefile"]
    built = [
        package / "_core.cpython-311-x86_64-linux-gnu.so",
        package / "hosts" / "mitsuba" / "plugins" / "tungsten_path.so",
        package / "bin" / "tungsten",
        package / "__pycache__" / "errors.cpython-311.pyc",
        package.parent / "tungsten_dip.egg-info" / "PKG-INFO",
        tmp_path / "build" / "dev" / "build.ninja",
    ]
    for path in (*kept, *built):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    shutil.copy(ROOT / "Makefile", tmp_path)
    subprocess.run(["make", "clean"], cwd=tmp_path, capture_output=True, check=True)
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == set(kept)
