"""Builds the C++ parts with CMake; all metadata is in pyproject.toml."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext


class CMakeBuild(build_ext):
    """Runs CMake once and lets it place the modules inside the package."""

    def build_extension(self, ext: Extension) -> None:
        """Configure and build the top-level CMakeLists.txt."""
        root = Path(__file__).parent.resolve()
        source = root / "python" / "tungsten_dip"
        package_dir = source if self.editable_mode else Path(self.build_lib).resolve() / "tungsten_dip"
        # The folder that setuptools chooses for an editable build is not kept: all would be compiled again.
        # A wheel has a folder of its own, since the cache names the place of the modules.
        build_dir = root / "build" / ("editable" if self.editable_mode else "wheel")
        # A cache of an earlier build may name a ninja that pip has removed since.
        ninja = shutil.which("ninja") or "ninja"
        subprocess.check_call(
            [
                "cmake", "-S", root, "-B", build_dir, "-G", "Ninja", "-DCMAKE_BUILD_TYPE=Release",
                f"-DPython_EXECUTABLE={sys.executable}", f"-DTUNGSTEN_DIP_PACKAGE_DIR={package_dir}",
                f"-DCMAKE_MAKE_PROGRAM={ninja}",
            ]
        )  # fmt: skip
        jobs = os.environ.get("CMAKE_BUILD_PARALLEL_LEVEL", str(os.cpu_count() or 1))
        subprocess.check_call(["cmake", "--build", build_dir, "--parallel", jobs])

    def copy_extensions_to_source(self) -> None:
        """Copy nothing: an editable build is placed among the sources to begin with."""


setup(ext_modules=[Extension("tungsten_dip._core", sources=[])], cmdclass={"build_ext": CMakeBuild})
