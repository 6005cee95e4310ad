"""What a network sees and what it blends: the part of a fit that is saved with it."""

from __future__ import annotations

from dataclasses import dataclass

SCORE_RADII = (2, 4, 8, 16)
"""Of the windows in which a pilot is scored."""


@dataclass(frozen=True)
class Pilot:
    """One window of regression, ``radius`` and ``step`` in pixels.

    ``k`` is the damping of non-local means by a guide; None: neighbours are weighted by features alone.
    ``with_position``: the pixel's position is a further feature. ``along_edges``: no regression, but the mean
    along the edges of the features, with the standard deviation ``radius``. It estimates how much of a pixel
    each surface covers better than the samples in the pixel do. ``by_color``: without features and albedo,
    which on mirrors, in glass and out of focus are as noisy as the colour.
    """

    radius: int
    k: float | None = None
    step: int = 1
    with_position: bool = False
    along_edges: bool = False
    by_color: bool = False


@dataclass(frozen=True)
class Layout:
    """The inputs of a network and the candidates it blends: the same for every image that it is used on.

    ``features`` names channels of the features. The candidates are the noisy image, then the ``pilots`` that
    our filters compute, then ``extra_count`` extra pilots: Open Image Denoise's image, the previous frame.
    ``baseline`` is the index of the candidate that the others are compared with, never the noisy image.
    """

    features: tuple[str, ...]
    pilots: tuple[Pilot, ...]
    extra_count: int
    baseline: int

    @property
    def candidate_count(self) -> int:
        """How many images the network blends."""
        return 1 + len(self.pilots) + self.extra_count

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of what `inputs_of_half` yields, in its order."""
        return (
            *self.features,
            "noise",
            "level",
            *(
                f"candidate {index} {what}"
                for index in range(self.candidate_count)
                if index != self.baseline
                for what in ("brightness", *(f"score {radius}" for radius in SCORE_RADII))
            ),
        )
