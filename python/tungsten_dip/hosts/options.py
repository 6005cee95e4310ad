"""The numbers that every host takes."""

from __future__ import annotations

from tungsten_dip.buffers.render_buffers import MOST_SPP
from tungsten_dip.cores import MOST_THREADS
from tungsten_dip.errors import whole_number

RANGES = {"spp": (1, MOST_SPP), "seed": (0, 2**32 - 1), "threads": (1, MOST_THREADS)}


def checked_option(name: str, value: int) -> int:
    """Return one of the numbers as Python's own; raise InputError if it is out of its range."""
    return whole_number(name, value, *RANGES[name])
