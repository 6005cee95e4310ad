"""What a network sees and what it blends: the part of a fit that is saved with it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

from tungsten_dip.errors import InputError

SCORE_RADII = (2, 4, 8, 16)
"""Radii of the windows in which a candidate is scored, in pixels."""


@dataclass(frozen=True)
class Pilot:
    """One filter, ``radius`` and ``step`` in pixels. What it does with the pixels around depends on its kind.

    - ``features``: a regression on the features, by which neighbours are weighted.
    - ``guided``: the same, with neighbours weighted by a guide; ``k`` is the damping of non-local means. Its
      result is averaged along the edges of the features.
    - ``color``: guided, without features and albedo, which on mirrors, in glass and out of focus are as noisy
      as the colour.
    - ``edges``: the mean along the edges of the features, with the standard deviation ``radius``. It
      estimates how much of a pixel each surface covers better than the samples in the pixel do.

    A regression looks at every ``step``-th row and column. ``with_position``: the pixel's position is a
    further feature of it.

    Raises ValueError if the radius is no multiple of the step, a guided kind lacks ``k``, or something is
    given that the kind does not use.
    """

    kind: Literal["features", "guided", "color", "edges"]
    radius: int
    step: int = 1
    k: float | None = None
    with_position: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.step <= self.radius or self.radius % self.step:
            raise ValueError(f"expected a radius that is a multiple of step, got {self.radius}, {self.step}")
        if (self.k is not None) != (self.kind in ("guided", "color")):
            raise ValueError(f"expected k for the kinds guided and color alone, got {self.k} for {self.kind}")
        if self.kind == "edges" and (self.step != 1 or self.with_position):
            raise ValueError("expected neither step nor position for the kind edges")


@dataclass(frozen=True)
class Layout:
    """The inputs of a network and the candidates it blends: the same for every image that it is used on.

    ``features`` names channels of the features. The candidates are the noisy image, then the ``pilots`` that
    our filters compute, then ``extra_count`` extra pilots: Open Image Denoise's image, the previous frame.
    ``baseline_index`` is that of the candidate that the others are compared with, never the noisy image.
    """

    features: tuple[str, ...]
    pilots: tuple[Pilot, ...]
    extra_count: int
    baseline_index: int

    @property
    def candidate_count(self) -> int:
        """How many images the network blends."""
        return 1 + len(self.pilots) + self.extra_count

    def check_fits(self, features: Collection[str], extra_count: int) -> None:
        """Raise InputError that names the difference if an image has not these features and extra pilots."""
        missing = [name for name in self.features if name not in features]
        if missing:
            raise InputError(
                f"the model was fitted with {', '.join(missing)}, which this input does not have; render it, "
                f"or fit without the model"
            )
        if self.extra_count != extra_count:
            raise InputError(
                f"the model was fitted with {self.extra_count} extra pilots (Open Image Denoise's image, the "
                f"previous frame), this input comes with {extra_count}; fit without the model"
            )

    def notes_on_features(self, features: Collection[str]) -> tuple[str, ...]:
        """Return a note on those of an image's features of which the network knows no channel, if any."""
        known, there = ({name.partition(".")[0] for name in names} for names in (self.features, features))
        unknown = ", ".join(sorted(there - known))
        return (f"the model was fitted without {unknown}: its network does not use it",) if unknown else ()

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of what `inputs_of_half` yields, in its order."""
        return (
            *self.features,
            "baseline error",
            "level",
            *(
                f"candidate {index} {what}"
                for index in range(self.candidate_count)
                if index != self.baseline_index
                for what in ("brightness", *(f"score {radius}" for radius in SCORE_RADII))
            ),
        )
