"""The callback by which long work reports its progress."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called as ``progress(fraction, message)``: the fraction done in [0, 1] and a few words (may be empty)."""


def silent(fraction: float, message: str) -> None:
    """Discard the report."""


def part_of(progress: Progress, start: float, end: float, name: str = "") -> Progress:
    """Return the callback of one part of the work, which takes the fractions from ``start`` to ``end``.

    The messages of the part follow ``name``, if it has one.
    """

    def report(fraction: float, message: str) -> None:
        done = (1 - fraction) * start + fraction * end
        progress(done, f"{name}: {message}" if name and message else name or message)

    return report
