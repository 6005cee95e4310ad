"""The number of threads, and work on two threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def thread_count(threads: int | None) -> int:
    """Return ``threads`` or, for None, one for each core that this process may run on."""
    if threads:
        return threads
    # macOS and Windows have no affinity.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_pair(function: Callable[[int], T], threads: int) -> tuple[T, T]:
    """Return ``function(0)`` and ``function(1)``, computed in parallel unless ``threads`` is 1.

    For work in numpy, which by itself keeps one core busy.
    """
    if threads == 1:
        return function(0), function(1)
    with ThreadPoolExecutor(2) as pool:
        a, b = pool.map(function, (0, 1))
    return a, b
