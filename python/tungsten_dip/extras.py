"""Optional packages, and the extra of this package that installs each: pip install 'tungsten-dip[EXTRA]'."""

from __future__ import annotations

from importlib.util import find_spec

from tungsten_dip.errors import InputError

EXTRA_BY_MODULE = {
    "torch": "paper",
    "mitsuba": "mitsuba",
    "drjit": "mitsuba",
    "flip_evaluator": "compare",
    "skimage": "compare",
    "pyoidn": "oidn",
    "dask": "cluster",
    "distributed": "cluster",
    "matplotlib": "bench",
}


def requirement(module: str, what: str) -> str:
    """Return the message that ``what`` needs a module, and how to install it."""
    return f"{what} needs {module}; install it with: pip install 'tungsten-dip[{EXTRA_BY_MODULE[module]}]'"


def require(module: str, what: str) -> None:
    """Raise InputError if a module that ``what`` needs is not installed, without importing it."""
    if find_spec(module) is None:
        raise InputError(requirement(module, what))
