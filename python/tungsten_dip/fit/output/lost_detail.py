"""Adds detail back that the fit has lost, where both halves confirm it.

A noisy pixel far darker or brighter than the result is noise as a rule, but not where light has leaked over
an edge that no feature contains, where a highlight was smoothed away, or where the network was fitted to
another image. The other half, whose noise is independent, distinguishes these cases.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.relmse import RELMSE_EPSILON
from tungsten_dip.buffers.render_buffers import FloatImage, Halves
from tungsten_dip.fit.preparation.exposure import BLACK

_Floats = npt.NDArray[np.float64]

_OCTAVES = np.arange(0, 4.5, 0.5)
"""Pixels so many factors of two darker (or brighter) than the result, or more, are judged together."""

_FEW = 6
"""From fewer pixels no slope is estimated: with heavy-tailed noise their standard error is too small."""

_STANDARD_ERRORS = 2.0
"""So many standard errors are subtracted from a slope."""


def with_lost_detail(halves: Halves, denoised: Halves, drawn: bool = False) -> Halves:
    """Add detail back to each half's image that its noisy half contains and the other half confirms.

    ``halves`` are the noisy halves and ``denoised`` the denoised ones, both linear and in the units of
    `evidence.Evidence`, shape (height, width, 3). With f a half's result, a its noisy half, b the other one
    and d = f^2 + 0.01, over all pixels in which a and f differ by some factor and more

        slope = sum p / sum q,  standard error = sqrt(sum (p - slope q)^2) / sum q  (White 1980),
        p = (a - f) (b - f) / d,  q = (a - f)^2 / d.

    The noise of b is independent, so the slope is the part of the difference a - f that is real; the part
    that is statistically certain is added back. On most images that is nothing. If the halves were ``drawn``
    from the image, only what is brighter is added: a pixel that no sample lit is 0 in both of its parts,
    which therefore confirm nothing.
    """
    octaves = [np.log2(_level(noisy) / _level(image)) for noisy, image in zip(halves, denoised, strict=True)]
    given = [image.copy() for image in denoised]
    for side in (1,) if drawn else (-1, 1):
        places = [np.nonzero(side * o >= _OCTAVES[1]) for o in octaves]
        octaves_apart = [side * o[place] for o, place in zip(octaves, places, strict=True)]
        products, squares = [], []
        for half, place in enumerate(places):
            image = denoised[half][place].astype(np.float64)
            own, other = halves[half][place] - image, halves[1 - half][place] - image
            denominator = image.mean(axis=1) ** 2 + RELMSE_EPSILON
            products.append((own * other).mean(axis=1) / denominator)
            squares.append((own**2).mean(axis=1) / denominator)
        slopes = _sure_slopes(*(np.concatenate(values) for values in (octaves_apart, products, squares)))
        for half, place in enumerate(places):
            share = np.interp(octaves_apart[half], _OCTAVES, slopes).astype(np.float32)[:, None]
            given[half][place] += share * (halves[half][place] - denoised[half][place])
    return given[0], given[1]


def _level(image: FloatImage) -> FloatImage:
    level: FloatImage = channel_mean(image)[..., 0] + np.float32(BLACK)
    return level


def _sure_slopes(octaves_apart: FloatImage, p: _Floats, q: _Floats) -> _Floats:
    """Return, for each of `_OCTAVES`, the certain part of the difference of pixels that far apart."""
    rung = np.searchsorted(_OCTAVES, octaves_apart, side="right") - 1

    def sum_beyond(values: _Floats) -> _Floats:
        sums: _Floats = np.bincount(rung, values, minlength=len(_OCTAVES)).astype(np.float64)
        return sums[::-1].cumsum()[::-1]

    total = np.maximum(sum_beyond(q), 1e-30)
    slopes = sum_beyond(p) / total
    residuals = sum_beyond(p**2) - 2 * slopes * sum_beyond(p * q) + slopes**2 * sum_beyond(q**2)
    sure = np.clip(slopes - _STANDARD_ERRORS * np.sqrt(np.maximum(residuals, 0)) / total, 0, 1)
    sure[sum_beyond(np.ones_like(q)) < _FEW] = 0
    sure[0] = 0
    # What is certain of some pixels holds for those yet farther apart.
    accumulated: _Floats = np.maximum.accumulate(sure)
    return accumulated
