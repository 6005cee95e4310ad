"""The images that a network blends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tungsten_dip.buffers.render_buffers import FloatImage, Halves


@dataclass(frozen=True)
class Candidates:
    """The noisy image, the pilots (one at least) and the extra pilots, in the order of the network's weights.

    Both halves of each are linear radiance of shape (height, width, 3), or (pixels, 3), in the units of
    `evidence.Evidence`. The first pilot blurs little: it stands in for the noisy image where that is too
    noisy (`estimate.held_out_error`), and for the previous frame where that has no value. The last one may be
    any: errors are relative to its level or, where the median of all is darker, to that (`measure`).
    """

    noisy: Halves
    pilots: tuple[Halves, ...]
    extra_pilots: tuple[Halves, ...] = ()

    @property
    def filtered(self) -> tuple[Halves, ...]:
        """All but the noisy image."""
        return (*self.pilots, *self.extra_pilots)

    @property
    def all(self) -> tuple[Halves, ...]:
        """All of them, in their order."""
        return (self.noisy, *self.filtered)

    def of_half(self, half: int) -> list[FloatImage]:
        """Return all that are made of one half, in their order."""
        return [candidate[half] for candidate in self.all]

    def map(self, function: Callable[[FloatImage], FloatImage]) -> Candidates:
        """Return the candidates with the function's value in place of each image."""

        def mapped(candidate: Halves) -> Halves:
            return function(candidate[0]), function(candidate[1])

        return Candidates(
            mapped(self.noisy),
            tuple(mapped(pilot) for pilot in self.pilots),
            tuple(mapped(pilot) for pilot in self.extra_pilots),
        )

    def rows(self, first: int, end: int) -> Candidates:
        """Return some rows of the candidates alone."""
        return self.map(lambda image: image[first:end])
