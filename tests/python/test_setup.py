"""How pip builds the C++ parts."""

import runpy
import subprocess
from pathlib import Path

import pytest
import setuptools

SETUP = Path(__file__).parents[2] / "setup.py"


def test_a_wheel_leaves_the_cache_of_an_editable_install_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[object]] = []
    monkeypatch.setattr(setuptools, "setup", lambda **_: None)
    monkeypatch.setattr(subprocess, "check_call", commands.append)
    build = runpy.run_path(str(SETUP))["CMakeBuild"](setuptools.Distribution())
    build.build_lib = "lib"
    caches = set()
    for build.editable_mode in (True, False):
        build.build_extension(setuptools.Extension("_core", sources=[]))
        configure, compile_ = commands[-2:]
        cache = configure[configure.index("-B") + 1]
        assert cache in compile_
        caches.add(cache)
    assert len(caches) == 2
