"""Fireflies: single samples so bright that no filter can spread them without leaving a blot.

Their radiance is limited. What this removes where nothing around is bright is given back, less a standard
error, spread over noisy surroundings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.render_buffers import FloatImage, Halves, mean_of
from tungsten_dip.fit.neighbours import mean_around, window_pixels

_RADIUS = 8
_LIMIT = 15.0
"""How many times brighter than its surroundings a pixel may be in one half alone."""

_LIMIT_OF_OTHER = 4.0
"""How many times brighter than in the other half: real detail is about equal in both halves."""

_FEW_SAMPLES = 0.35
"""Relative variance of a mean that some three samples carry: a firefly may have struck both halves. Of four
samples in all, two that are equal have 1/3, and pass."""

_CROWD = 3
"""So many spots of the other half, all as bright as a pixel that they surround, are no chance: few samples
find this light, such as a lamp out of focus or a caustic."""

_SPOT_RADIUS = 2
"""A spot is the brightest of 5x5 pixels: over so many a pixel filter may spread one sample."""

_CROWD_PIXELS = 1 << 12
"""Pixels whose surroundings are sorted at a time."""

_ROUNDS = 100
"""Enough for a cluster of 3x3 pixels, which every round lowers to 0.4 of itself, from 1e30 to 1e-10."""

_SETTLED = 0.9
"""The mean of the surroundings has converged once a round lowers no pixel below this part of itself."""

_BRIGHTEST = 1e30
"""Sums of brighter pixels overflow."""

_MOST_RETURNED = 60.0
"""No firefly gives back more than so many times the radiance around it: few hold most of what is removed."""

_BRIGHT_SPOT = 2.0
"""Where the other half is so many times brighter near a firefly than farther around, its light belongs to a
lamp or a highlight, and would be wrong anywhere else. One firefly of the other half, limited to 15 times its
surroundings, does not make 5x5 pixels so bright."""

_LARGEST_GAIN = 1.5
"""Where little else is noisy, a few pixels would get back what fireflies lost all over the image."""

_LEAST = 1e-15
"""Divisors are no less, in radiance."""


@dataclass(frozen=True)
class Limited:
    """Both halves with their fireflies limited, linear radiance of shape (height, width, 3).

    ``gain``, shape (height, width, 1), from 1 to 1.5, times the denoised image gives back some of the
    radiance removed. ``note`` is a line on that radiance. Both are None without fireflies.
    """

    halves: Halves
    gain: FloatImage | None = None
    note: str | None = None


def limit_fireflies(
    half_a: FloatImage,
    half_b: FloatImage,
    threads: int,
    emission: Halves | None = None,
    deviation: FloatImage | None = None,
) -> Limited:
    """Scale down pixels of one half that neither their surroundings nor the other half support.

    The halves, their ``emission`` (None: there is none) and ``deviation``, the standard deviation of the mean
    of all samples (None: unknown), are linear radiance of shape (height, width, 3). Pixels keep their
    radiance

    - up to 15 times the mean of both halves in the 17x17 pixels around them;
    - if it is about equal in both halves. If the deviation is known, it must show that more than a few
      samples carry the radiance, unless the pixel has emission;
    - if three spots around them in the other half are as bright: in emission, if theirs is mostly emission,
      and else without it. A lamp beside a firefly tells nothing of it.

    Where this leaves out most of the pixels that have any light, they are the image (stars, or a caustic on
    black), and fireflies are 15 times brighter than their median.
    """
    levels = [_level(half) for half in (half_a, half_b)]
    mean = (levels[0] + levels[1]) / 2
    around = _surroundings(mean, threads)
    lights = [_level(light) for light in emission] if emission else [np.zeros_like(mean)] * 2
    confirmed = np.ones(mean.shape, bool)
    if deviation is not None:
        confirmed = (_level(deviation) ** 2 <= _FEW_SAMPLES * mean**2) | (lights[0] + lights[1] > 0)
    limits = []
    for half, level in enumerate(levels):
        other, light_of_other = levels[1 - half], lights[1 - half]
        limit = np.maximum(_LIMIT * around, _LIMIT_OF_OTHER * other * confirmed)
        emits = 2 * lights[half] > level
        for kind, of_other in ((emits, light_of_other), (~emits, np.maximum(other - light_of_other, 0))):
            limit = np.maximum(limit, _crowd(kind & (level > limit), of_other))
        limits.append(limit)
    count = sum(int(np.count_nonzero(level > limit)) for level, limit in zip(levels, limits, strict=True))
    lit = sum(int(np.count_nonzero(level)) for level in levels)
    if 2 * count > lit:
        typical = np.median(np.concatenate([level[level > 0] for level in levels]))
        limits = [np.maximum(limit, _LIMIT * typical) for limit in limits]
        count = sum(int(np.count_nonzero(level > limit)) for level, limit in zip(levels, limits, strict=True))
    if count == 0:
        return Limited((half_a, half_b))
    a, b = (_limited(*given) for given in zip((half_a, half_b), levels, limits, strict=True))
    taken = [np.maximum(level - limit, 0) for level, limit in zip(levels, limits, strict=True)]
    share = float(taken[0].sum() + taken[1].sum()) / float(levels[0].sum() + levels[1].sum())
    noun = "firefly" if count == 1 else "fireflies"
    note = (
        f"{count} {noun} limited, with {100 * share:.3g}% of the image's energy, which the estimated error "
        "leaves out"
    )
    returned = [
        np.where(_is_spot(channel_mean(other), threads), 0, np.minimum(t, _MOST_RETURNED * around))
        for t, other in zip(taken, (b, a), strict=True)
    ]
    return Limited((a, b), _gain([r.astype(np.float32) for r in returned], (a, b), threads), note)


_Levels = npt.NDArray[np.float64]


def _level(image: FloatImage) -> _Levels:
    level: _Levels = image.mean(axis=2, keepdims=True, dtype=np.float64)
    return level


def _crowd(struck: npt.NDArray[np.bool_], other: _Levels) -> _Levels:
    """Return how bright the `_CROWD` brightest spots of the other half are around pixels struck, else 0."""
    crowd = np.zeros_like(other)
    rows, columns = np.nonzero(struck[:, :, 0])
    if not rows.size:
        return crowd
    size = 2 * _RADIUS + 1
    windows = sliding_window_view(np.pad(_spots(other[:, :, 0]), _RADIUS), (size, size))
    for first in range(0, len(rows), _CROWD_PIXELS):
        at = rows[first : first + _CROWD_PIXELS], columns[first : first + _CROWD_PIXELS]
        crowd[at] = np.partition(windows[at].reshape(-1, size**2), -_CROWD)[:, -_CROWD, None]
    return crowd


def _spots(image: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return an image, shape (height, width), black but for the brightest of the pixels around each."""
    height, width = image.shape
    padded = np.pad(image, _SPOT_RADIUS)
    brightest = np.ones(image.shape, bool)
    side = 2 * _SPOT_RADIUS + 1
    for dy, dx in np.ndindex(side, side):
        beside = padded[dy : dy + height, dx : dx + width]
        # Of equal ones the first.
        before = (dy, dx) < (_SPOT_RADIUS, _SPOT_RADIUS)
        brightest &= image > beside if before else image >= beside
    return np.where(brightest, image, 0)


def _limited(image: FloatImage, level: _Levels, limit: _Levels) -> FloatImage:
    """Return the image, no brighter than the limit."""
    over = level > limit
    factor = np.where(over, limit / np.where(over, level, 1), 1)
    limited: FloatImage = image * factor.astype(np.float32)
    return limited


def _is_spot(level: FloatImage, threads: int) -> npt.NDArray[np.bool_]:
    """Return where the pixels around are far brighter than those farther around, shape (height, width, 1)."""
    near, far = (_core.box_mean(level, radius, threads) for radius in (_SPOT_RADIUS, _RADIUS))
    spot: npt.NDArray[np.bool_] = near > np.float32(_BRIGHT_SPOT) * far
    return spot


def _gain(taken: list[FloatImage], halves: Halves, threads: int) -> FloatImage:
    """Return 1 plus what was ``taken`` from the halves, less its standard error, relative to their level.

    It is the mean over a window of half the image's longer side, and goes where the halves differ: pixels
    without noise keep their radiance, and those noisier than the mean, as in a highlight, get no more than
    others. Fireflies strike independently of one another, so that the variance of their sum is the sum of
    their squares; those within a spot count as one, which a pixel filter may have spread.
    """
    radius = max(taken[0].shape[:2]) // 4

    def mean(values: FloatImage) -> FloatImage:
        return _core.box_mean(values, radius, threads)

    spot = window_pixels(taken[0].shape, _SPOT_RADIUS)
    squares = [t * spot * _core.box_mean(t, _SPOT_RADIUS, threads) for t in taken]
    variance = np.float32(0.5) * mean_of((squares[0], squares[1]))
    error = np.sqrt(mean(variance) / window_pixels(spot.shape, radius))
    given = np.maximum(mean(mean_of((taken[0], taken[1]))) - error, 0)
    a, b = (channel_mean(half) for half in halves)
    level = _core.box_mean(mean_of((a, b)), _RADIUS, threads)
    noise = _core.box_mean(np.abs(a - b), _RADIUS, threads)
    noise = np.minimum(noise, mean(noise))
    share = noise / np.maximum(mean(noise), np.float32(_LEAST))
    gain = 1 + given * share / np.maximum(level, np.float32(_LEAST))
    bounded: FloatImage = np.minimum(gain, _LARGEST_GAIN).astype(np.float32)
    return bounded


def _surroundings(level: _Levels, threads: int) -> FloatImage:
    """Return the mean around every pixel, to which no other pixel adds more than `_LIMIT` times its own."""
    capped = np.minimum(level, _BRIGHTEST).astype(np.float32)
    for _ in range(_ROUNDS):
        around = mean_around(capped, _RADIUS, threads)
        lower = np.minimum(capped, np.float32(_LIMIT) * around)
        if (lower >= np.float32(_SETTLED) * capped).all():
            break
        capped = lower
    return around
