"""Work on two halves, of the samples or of a picture, at the same time."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def of_both_halves(work: Callable[[int], T], threads: int) -> tuple[T, T]:
    """Return ``work(0)`` and ``work(1)``, done side by side unless ``threads`` is 1.

    For work in numpy, which by itself keeps one core busy.
    """
    if threads == 1:
        return work(0), work(1)
    with ThreadPoolExecutor(2) as pool:
        a, b = pool.map(work, (0, 1))
    return a, b
