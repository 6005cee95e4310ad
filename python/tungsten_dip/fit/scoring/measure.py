"""How well candidates predict: errors of one half's images by the other half, and what they relate to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.channels import channel_mean
from tungsten_dip.buffers.relmse import RELMSE_EPSILON
from tungsten_dip.buffers.render_buffers import FloatImage, Halves
from tungsten_dip.fit.candidates import Candidates
from tungsten_dip.fit.neighbours import mean_around

_ERROR_RADIUS = 8

_OUTLIER = 20.0
"""Squared errors are capped at so many times what those by a half itself are in the pixels around."""

_LEAST_CAP = 1e-3
"""Errors up to here are never capped as outliers."""

_BAND_ROWS = 64
"""Rows of all pilots that are sorted at a time: large images need gigabytes for each copy."""


@dataclass(frozen=True)
class ErrorMeasure:
    """What squared errors of each half are relative to, and up to what they count, both (height, width, 1).

    Both are made from the half itself, so that neither errors nor scores of a pixel depend on its value in
    the half that scores it.
    """

    denominators: Halves
    caps: Halves

    def error(self, half: int, image: FloatImage, other: FloatImage) -> FloatImage:
        """Return the error of an image of one half by the ``other`` half, shape (height, width, 1)."""
        relative = _relative_error(image, other, self.denominators[half])
        error: FloatImage = np.minimum(relative, self.caps[half])
        return error

    def errors_around(self, candidate: Halves, halves: Halves, threads: int) -> Halves:
        """Return the mean errors of both halves of a candidate in the pixels around each."""
        a, b = (
            mean_around(self.error(half, candidate[half], halves[1 - half]), _ERROR_RADIUS, threads)
            for half in (0, 1)
        )
        return a, b

    def rows(self, first: int, end: int) -> ErrorMeasure:
        """Return the measure of some rows alone."""
        denominators, caps = ((a[first:end], b[first:end]) for a, b in (self.denominators, self.caps))
        return ErrorMeasure(denominators, caps)


def error_measure(candidates: Candidates, threads: int) -> ErrorMeasure:
    """Return the measure for the errors of candidates."""
    denominators = _denominators(candidates.pilots)
    return ErrorMeasure(denominators, _caps(candidates, denominators, threads))


def best_candidate(candidates: Candidates, measure: ErrorMeasure) -> int:
    """Return the index of the candidate with the least error; the noisy image, the first, does not count."""

    def mean_error(candidate: Halves) -> float:
        halves = candidates.noisy[::-1]
        return sum(
            float(np.minimum(_relative_error(image, other, denominator), 1).mean())
            for image, other, denominator in zip(candidate, halves, measure.denominators, strict=True)
        )

    return 1 + int(np.argmin([mean_error(candidate) for candidate in candidates.filtered]))


def _denominators(pilots: Sequence[Halves]) -> Halves:
    """Return the squared level of each half's last pilot or, where that is less, the median one, plus 0.01.

    Relative to itself, a pilot that spreads a lamp over dark pixels beside it would have little error there.
    """
    a, b = (np.empty((*half.shape[:2], 1), np.float32) for half in pilots[-1])
    for half, denominator in enumerate((a, b)):
        for first in range(0, len(denominator), _BAND_ROWS):
            band = slice(first, first + _BAND_ROWS)
            levels = [channel_mean(pilot[half][band]) for pilot in pilots]
            denominator[band] = np.minimum(levels[-1], np.median(levels, axis=0)) ** 2
        denominator += np.float32(RELMSE_EPSILON)
    return a, b


def _caps(candidates: Candidates, denominators: Halves, threads: int) -> Halves:
    """Return the caps, from the mean error of each half's candidates by that half itself."""

    def cap(half: int) -> FloatImage:
        noisy, denominator = candidates.noisy[half], denominators[half]
        errors = (_relative_error(candidate[half], noisy, denominator) for candidate in candidates.filtered)
        mean = sum(errors, np.zeros_like(denominator)) / np.float32(len(candidates.filtered))
        around = _core.box_mean(mean, _ERROR_RADIUS, threads)
        return np.float32(_OUTLIER) * around + np.float32(_LEAST_CAP)

    return cap(0), cap(1)


def _relative_error(image: FloatImage, other: FloatImage, denominator: FloatImage) -> FloatImage:
    """Return the mean squared difference of the channels over a denominator, shape (height, width, 1)."""
    error: FloatImage = channel_mean((image - other) ** 2) / denominator
    return error
