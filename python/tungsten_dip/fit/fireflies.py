"""Fireflies: single samples so bright that no filter can spread them without leaving a blot."""

from __future__ import annotations

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.model import FloatImage

_RADIUS = 8
_LIMIT = 30.0
"""How many times brighter than its surroundings a pixel may be that only one half of the samples shows so."""


def limit_fireflies(
    half_a: FloatImage, half_b: FloatImage, threads: int
) -> tuple[tuple[FloatImage, FloatImage], str | None]:
    """Scale down pixels of one half that neither their surroundings nor the other half support.

    What is bright in both halves is left alone, whatever its radiance, and so is everything up to 30 times the
    mean of the 17x17 pixels around it. Returns both halves and a note of what was taken away, if anything.
    """
    levels = [half.mean(axis=2, keepdims=True) for half in (half_a, half_b)]
    # A firefly must not raise its own limit nor, much, that of the pixels around it.
    count = (2 * _RADIUS + 1) ** 2
    mean = _core.box_mean((levels[0] + levels[1]) / 2, _RADIUS, threads)
    mean = _core.box_mean(np.minimum((levels[0] + levels[1]) / 2, _LIMIT * mean), _RADIUS, threads)
    limited, taken, pixels = [], 0.0, 0
    for half, level, other in zip((half_a, half_b), levels, levels[::-1], strict=True):
        around = np.maximum(mean - np.minimum(level / 2, _LIMIT * mean) / np.float32(count), 0)
        limit = np.float32(_LIMIT) * np.maximum(around, other)
        over = (level > limit) & (level > 0)
        factor = np.where(over, limit / np.where(over, level, 1), 1).astype(np.float32)
        limited.append(half * factor)
        pixels += int(over.sum())
        taken += float((level - level * factor).sum(dtype=np.float64))
    if pixels == 0:
        return (half_a, half_b), None
    total = sum(float(level.sum(dtype=np.float64)) for level in levels)
    note = f"{pixels} fireflies limited, with {100 * taken / total:.2g}% of the image's energy"
    return (limited[0], limited[1]), note
