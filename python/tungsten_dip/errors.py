"""The one exception for what a user can fix: bad files, bad scenes, bad settings."""

from numbers import Integral
from typing import Any


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what was expected, what was found, what to do."""


def check_type(what: str, value: Any, expected: type, remedy: str) -> None:
    """Raise InputError if a value is of another type."""
    if not isinstance(value, expected):
        raise InputError(f"{what}: expected {expected.__name__}, got {type(value).__name__}; {remedy}")


def whole_number(what: str, value: Any, least: int, most: int) -> int:
    """Return a number, perhaps of numpy's, which neither JSON nor a renderer takes, as Python's own.

    Raises InputError if it is no whole number of this range.
    """
    if not (isinstance(value, Integral) and least <= int(value) <= most):
        raise InputError(f"{what}: expected a whole number from {least} to {most}, got {value!r:.40}")
    return int(value)
