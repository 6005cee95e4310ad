"""Errors in words: the one line that a user is told, and whether it is for the user to mend."""

from __future__ import annotations

from tungsten_dip.errors import InputError
from tungsten_dip.extras import EXTRA_BY_MODULE, requirement

_NO_MEMORY = (
    "t allocate memory",
    "Cannot allocate memory",
    "Failed to allocate memory",
    "bad_alloc",
    "failed to map segment",
    "error return without exception set",
    # A thread needs memory for its stack.
    "can't start new thread",
    "Resource temporarily unavailable",
)
"""What torch, onnxruntime, the loader of libraries and CPython say in place of raising MemoryError."""


def line_of_failure(error: BaseException) -> tuple[str, bool]:
    """Return what is told of an error, in one line, and whether the user can mend it; if not, it is a bug."""
    mendable = True
    if isinstance(error, OSError) and error.filename is not None:
        line = f"{error.filename}: {error.strerror}; check the path and its permissions"
    elif isinstance(error, (InputError, OSError)) and str(error):
        line = str(error)
    elif isinstance(error, ModuleNotFoundError) and error.name in EXTRA_BY_MODULE:
        line = requirement(error.name, "this")
    elif isinstance(error, MemoryError) or any(phrase in str(error) for phrase in _NO_MEMORY):
        line = f"not enough memory ({str(error)[:200] or 'none left'}); free some, or use a smaller image"
    else:
        line, mendable = f"{type(error).__name__}: {error}".removesuffix(": "), False
    return " ".join(line.split()), mendable
