"""The one exception for what a user can fix: bad files, bad scenes, bad settings."""

import math
from collections.abc import Collection
from numbers import Integral, Real
from typing import Any


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what was expected, what was found, what to do."""


def check_type(what: str, value: Any, expected: type, remedy: str) -> None:
    """Raise InputError if a value is of another type."""
    if not isinstance(value, expected):
        raise InputError(f"{what}: expected {expected.__name__}, got {type(value).__name__}; {remedy}")


def check_choice(what: str, value: Any, choices: Collection[str]) -> None:
    """Raise InputError if a value is none of these."""
    if not (isinstance(value, str) and value in choices):
        raise InputError(f"{what}: expected {', '.join(choices)}, got {_shown(value)}; choose one of these")


def whole_number(what: str, value: Any, least: int, most: int) -> int:
    """Return a number, perhaps of numpy's, which neither JSON nor a renderer takes, as Python's own.

    Raises InputError if it is no whole number of this range.
    """
    if not (isinstance(value, Integral) and least <= int(value) <= most):
        raise InputError(f"{what}: expected a whole number from {least} to {most}, got {_shown(value)}")
    return int(value)


def positive_number(what: str, value: Any) -> float:
    """Return a number, perhaps of numpy's, as Python's own.

    Raises InputError if it is none, is not above 0, or is too large for a float.
    """
    try:
        number = float(value) if isinstance(value, Real) else math.nan
    except OverflowError:
        number = math.inf
    if not 0 < number < math.inf:
        raise InputError(f"{what}: expected a finite number above 0, got {_shown(value)}")
    return number


def _shown(value: Any) -> str:
    """A value in short, in one line, which numpy's arrays are not."""
    return f"{' '.join(repr(value).split()):.40}"
