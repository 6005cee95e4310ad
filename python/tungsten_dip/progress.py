"""How long work tells its caller where it stands, without knowing who is listening."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called as ``progress(fraction, message)``: the fraction done in [0, 1] and a few words (may be empty)."""


def silent(fraction: float, message: str) -> None:
    """Report to nobody."""
