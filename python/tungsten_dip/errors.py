"""The one exception for what a user can fix: bad files, bad scenes, bad settings."""

from typing import Any


class InputError(ValueError):
    """Input that cannot be used. The message is one line: what was expected, what was found, what to do."""


def check_type(what: str, value: Any, expected: type, remedy: str) -> None:
    """Raise InputError if a value is of another type."""
    if not isinstance(value, expected):
        raise InputError(f"{what}: expected {expected.__name__}, got {type(value).__name__}; {remedy}")
