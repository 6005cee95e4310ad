"""Brings the inputs of a network to a common scale."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.render_buffers import FloatArray
from tungsten_dip.cores import in_pair

LARGEST_INPUT = 4.0
_LEAST_SPREAD = 1e-6
_PART_PIXELS = 1 << 11


@dataclass(frozen=True)
class Standardisation:
    """Brings every input to mean 0 and standard deviation 1 on the image that it was made for."""

    mean: npt.NDArray[np.float64]
    std: FloatArray

    def apply(self, inputs: FloatArray, threads: int) -> None:
        """Standardise inputs in place, shape (2, pixels, inputs), clipped to 4 standard deviations."""

        def standardise(half: int) -> None:
            for part in _parts(inputs[half]):
                np.clip(
                    (part - self.mean) / self.std,
                    -LARGEST_INPUT,
                    LARGEST_INPUT,
                    out=part,
                    casting="same_kind",
                )

        in_pair(standardise, threads)


def standardisation_of(inputs: FloatArray, threads: int) -> Standardisation:
    """Return mean and standard deviation of every input, which have the shape (2, pixels, inputs)."""
    count = inputs.shape[0] * inputs.shape[1]

    def sums(half: int) -> Any:
        return sum(part.sum(axis=0, dtype=np.float64) for part in _parts(inputs[half]))

    def squares(half: int) -> Any:
        return sum(((part - mean) ** 2).sum(axis=0) for part in _parts(inputs[half]))

    mean = sum(in_pair(sums, threads)) / count
    variance = sum(in_pair(squares, threads)) / count
    return Standardisation(mean, np.maximum(np.sqrt(variance), _LEAST_SPREAD).astype(np.float32))


def _parts(inputs: FloatArray) -> Iterator[FloatArray]:
    """Yield some pixels after the other, all inputs of them: views that fit the processor's cache."""
    for first in range(0, len(inputs), _PART_PIXELS):
        yield inputs[first : first + _PART_PIXELS]
