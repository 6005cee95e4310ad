"""What a network sees and chooses among: the part of a fit that is saved with it."""

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
    """The inputs of a network and the images it chooses among: the same for every image that it is used on.

    ``features`` names channels of the features. The images are the noisy one, then the ``pilots`` that
    filters compute, then the candidates: Open Image Denoise's image, the previous frame.
    ``baseline`` is the index of the pilot that the others are compared with.
    """

    features: tuple[str, ...]
    pilots: tuple[Pilot, ...]
    candidate_count: int
    baseline: int

    @property
    def choice_count(self) -> int:
        """How many images the network chooses among."""
        return 1 + len(self.pilots) + self.candidate_count

    @property
    def inputs(self) -> tuple[str, ...]:
        """The names of what `inputs_of_half` yields, in its order."""
        return (
            *self.features,
            "noise",
            "level",
            *(
                f"choice {index} {what}"
                for index in range(self.choice_count)
                if index != self.baseline
                for what in ("brightness", *(f"score {radius}" for radius in SCORE_RADII))
            ),
        )
