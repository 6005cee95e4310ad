"""How many threads to use where nobody has said."""

from __future__ import annotations

import os


def thread_count(threads: int | None) -> int:
    """Return ``threads`` or, for None, one for each core that this process may run on."""
    if threads:
        return threads
    # macOS and Windows do not tell.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
