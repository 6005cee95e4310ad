"""The stages of a fit, in their order, and the part of its progress that each takes."""

from __future__ import annotations

from typing import Literal

from tungsten_dip.progress import Progress, part_of

Stage = Literal["features", "extra pilots", "pilots", "training"]

_PARTS: dict[Stage, tuple[float, float]] = {
    "features": (0.0, 0.1),
    "extra pilots": (0.1, 0.15),
    "pilots": (0.15, 0.75),
    "training": (0.75, 1.0),
}


def stage(progress: Progress, name: Stage) -> Progress:
    """Return the callback of one stage, which takes its own fractions, from 0 to 1."""
    return part_of(progress, *_PARTS[name])
