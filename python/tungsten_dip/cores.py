"""The number of threads, and work on several."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

MOST_THREADS = 1024

S = TypeVar("S")
T = TypeVar("T")


def thread_count(threads: int | None) -> int:
    """Return ``threads`` or, for None, one for each core that this process may run on."""
    if threads is not None:
        return threads
    # macOS has no affinity.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_parallel(function: Callable[[S], T], items: Sequence[S], threads: int) -> list[T]:
    """Return the function's value for every item, computed in parallel unless ``threads`` is 1.

    For work in libraries that by themselves keep one core busy.
    """
    if threads == 1 or len(items) == 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(min(threads, len(items))) as pool:
        return list(pool.map(function, items))


def in_pair(function: Callable[[int], T], threads: int) -> tuple[T, T]:
    """Return ``function(0)`` and ``function(1)``, computed in parallel unless ``threads`` is 1."""
    a, b = in_parallel(function, (0, 1), threads)
    return a, b
