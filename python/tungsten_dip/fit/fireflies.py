"""Fireflies: single samples so bright that no filter can spread them without leaving a blot."""

from __future__ import annotations

import numpy as np

from tungsten_dip.buffers.model import FloatImage, Halves
from tungsten_dip.fit.neighbours import mean_around

_RADIUS = 8
_LIMIT = 15.0
"""How many times brighter than its surroundings a pixel may be in one half alone."""

_LIMIT_OF_OTHER = 4.0
"""How many times brighter than in the other half: real detail is about equal in both halves."""

_ROUNDS = 100
"""Enough for a cluster of 3x3 pixels, which every round lowers to 0.4 of itself, from 1e30 to 1e-10."""

_SETTLED = 0.9
"""The mean of the surroundings has converged once a round lowers no pixel below this part of itself."""

_BRIGHTEST = 1e30
"""Sums of brighter pixels overflow."""


def limit_fireflies(half_a: FloatImage, half_b: FloatImage, threads: int) -> tuple[Halves, str | None]:
    """Scale down pixels of one half that neither their surroundings nor the other half support.

    What is about equal in both halves is left alone, whatever its radiance, and so is everything up to 15
    times the mean of the 17x17 pixels around it. Returns both halves and a note on the radiance that was
    removed, if any.
    """
    levels = [_level(half) for half in (half_a, half_b)]
    around = _surroundings((levels[0] + levels[1]) / 2, threads)
    limits = [np.maximum(_LIMIT * around, _LIMIT_OF_OTHER * other) for other in levels[::-1]]
    (a, taken_a), (b, taken_b) = (
        _limited(*given) for given in zip((half_a, half_b), levels, limits, strict=True)
    )
    return (a, b), _note(np.concatenate((taken_a, taken_b)), float(levels[0].sum() + levels[1].sum()))


_Levels = np.ndarray[tuple[int, ...], np.dtype[np.float64]]


def _level(image: FloatImage) -> _Levels:
    level: _Levels = image.mean(axis=2, keepdims=True, dtype=np.float64)
    return level


def _limited(image: FloatImage, level: _Levels, limit: _Levels) -> tuple[FloatImage, _Levels]:
    """Return the image, no brighter than the limit, and what every pixel that was brighter has lost."""
    over = level > limit
    factor = np.where(over, limit / np.where(over, level, 1), 1)
    limited: FloatImage = image * factor.astype(np.float32)
    return limited, (level - limit)[over]


def _note(taken: _Levels, total: float) -> str | None:
    if taken.size == 0:
        return None
    noun = "firefly" if taken.size == 1 else "fireflies"
    return f"{taken.size} {noun} limited, with {100 * taken.sum() / total:.3g}% of the image's energy"


def _surroundings(level: _Levels, threads: int) -> FloatImage:
    """Return the mean around every pixel, to which no other pixel adds more than `_LIMIT` times its own."""
    capped = np.minimum(level, _BRIGHTEST).astype(np.float32)
    for _ in range(_ROUNDS):
        around = np.maximum(mean_around(capped, _RADIUS, threads), 0)
        lower = np.minimum(capped, np.float32(_LIMIT) * around)
        if (lower >= np.float32(_SETTLED) * capped).all():
            break
        capped = lower
    return around
