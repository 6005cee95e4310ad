"""The machine that was measured on, and the versions of the packages."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from tungsten_dip.cores import thread_count

PACKAGES = (
    "tungsten-dip",
    "onnxruntime",
    "torch",
    "numpy",
    "pyoidn",
    "mitsuba",
    "flip-evaluator",
    "scikit-image",
)


def cpu_model() -> str:
    """Return the processor's name as the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()


def machine_facts(threads: int | None = None) -> list[tuple[str, str]]:
    """Return names and values: processor, cores, threads in use, system, versions of packages."""
    facts = [
        ("processor", cpu_model()),
        ("cores", str(os.cpu_count())),
        ("threads in use", str(thread_count(threads))),
        ("system", f"{platform.system()} {platform.release()}, Python {platform.python_version()}"),
    ]
    if find_spec("torch") is not None:
        import torch

        if torch.cuda.is_available():
            facts.append(("graphics processor", torch.cuda.get_device_name()))
    return facts + [(name, version) for name in PACKAGES if (version := _version(name))]


def machine_key(threads: int | None = None) -> str:
    """Return in a few words what must stay the same for two measurements to be of one kind."""
    return f"{cpu_model()} with {thread_count(threads)} threads"


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
