"""Gives back detail that the fit has lost, where both halves agree on it.

A noisy pixel far darker or brighter than the result is noise as a rule, but not where light has leaked over
an edge that no feature shows, where a highlight was smoothed away, or where the network was fitted to another
image. The half of the samples that was not looked at tells which.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.model import FloatImage, Halves
from tungsten_dip.fit.settings import RELMSE_EPSILON

_Floats = npt.NDArray[np.float64]

_OCTAVES = np.arange(0, 4.5, 0.5)
"""Pixels so many factors of two darker (or brighter) than the result, or more, are judged together."""

_FEW = 6
"""Fewer pixels tell nothing of others: among heavy-tailed noise their standard error is too small."""

_SURELY = 2.0
"""So many standard errors are taken from a slope before it is believed."""

_BLACK = 2e-3
"""Levels below are compared as black; the median of lit pixels is about 0.25."""


def with_what_was_lost(halves: Halves, fused: Halves) -> Halves:
    """Give back to each half's image what its noisy half rightly shows otherwise.

    ``halves`` are the noisy halves and ``fused`` what was made of each alone, both in the units of
    `evidence.Evidence`, shape (height, width, 3). Over all pixels that differ by some factor and more, the
    difference of the *other* half from the result is regressed on this half's. Its noise is independent, so
    the slope is the part of the difference that is true; as much of it as is sure is given back. On most
    images that is nothing.
    """
    octaves = [np.log2(_level(noisy) / _level(image)) for noisy, image in zip(halves, fused, strict=True)]
    given = [image.copy() for image in fused]
    for side in (-1, 1):
        places = [np.nonzero(side * o >= _OCTAVES[1]) for o in octaves]
        apart = [side * o[place] for o, place in zip(octaves, places, strict=True)]
        own, told = [], []
        for half, place in enumerate(places):
            image = fused[half][place].astype(np.float64)
            shown, shown_by_other = halves[half][place] - image, halves[1 - half][place] - image
            denominator = image.mean(axis=1) ** 2 + RELMSE_EPSILON
            own.append((shown**2).mean(axis=1) / denominator)
            told.append((shown * shown_by_other).mean(axis=1) / denominator)
        slopes = _sure_slopes(np.concatenate(apart), np.concatenate(own), np.concatenate(told))
        for half, place in enumerate(places):
            share = np.interp(apart[half], _OCTAVES, slopes).astype(np.float32)[:, None]
            given[half][place] += share * (halves[half][place] - fused[half][place])
    return given[0], given[1]


def _level(image: FloatImage) -> FloatImage:
    level: FloatImage = channel_mean(image)[..., 0] + np.float32(_BLACK)
    return level


def _sure_slopes(apart: FloatImage, own: _Floats, told: _Floats) -> _Floats:
    """Return, for each of `_OCTAVES`, which part of the difference of pixels so far apart is surely true."""
    rung = np.searchsorted(_OCTAVES, apart, side="right") - 1

    def as_far(values: _Floats) -> _Floats:
        sums: _Floats = np.bincount(rung, values, minlength=len(_OCTAVES)).astype(np.float64)
        return sums[::-1].cumsum()[::-1]

    total = np.maximum(as_far(own), 1e-30)
    slopes = as_far(told) / total
    residuals = as_far(told**2) - 2 * slopes * as_far(told * own) + slopes**2 * as_far(own**2)
    sure = np.clip(slopes - _SURELY * np.sqrt(np.maximum(residuals, 0)) / total, 0, 1)
    sure[as_far(np.ones_like(own)) < _FEW] = 0
    sure[0] = 0
    # What is true of some pixels is true of those yet farther apart.
    accumulated: _Floats = np.maximum.accumulate(sure)
    return accumulated
