"""What the presets draft, balanced and final do: their pilots, and how their network is trained."""

from __future__ import annotations

from dataclasses import dataclass, replace

from tungsten_dip.fit.layout import Pilot
from tungsten_dip.fit.pilots.surfaces import EDGES_SIGMA
from tungsten_dip.fit.settings import FitSettings, Preset

_EDGES = Pilot("edges", EDGES_SIGMA)

# Small windows keep detail, large ones average out the remaining noise; guided ones keep shadows and
# reflections, which no feature contains; a regression on the position follows gradients. Within a time budget
# the first ones are computed, so that cheap ones come first. The very first blurs little: it stands in where
# the noisy image or the previous frame cannot be used. Errors are relative to the last one that is computed
# or, where the median of all is darker, to that.
DRAFT_PILOTS = (Pilot("features", 1), _EDGES, Pilot("features", 6, step=2), Pilot("guided", 6, step=2, k=1.0))
BALANCED_PILOTS = (
    Pilot("features", 1),
    _EDGES,
    Pilot("features", 5),
    Pilot("features", 12, step=2, with_position=True),
    Pilot("guided", 4, k=1.0),
    Pilot("guided", 10, step=2, k=1.0),
    Pilot("guided", 10, step=2, k=2.0, with_position=True),
    Pilot("guided", 18, step=2, k=1.5, with_position=True),
    Pilot("color", 4, k=1.0),
)
# Larger windows leave fewer blotches on smooth walls and in fog.
FINAL_PILOTS = (
    *BALANCED_PILOTS,
    Pilot("features", 24, step=3, with_position=True),
    Pilot("guided", 32, step=4, k=2.0, with_position=True),
)

# Enough beside the previous frame. The first replaces it where it has no value, guided ones show what has
# moved although no feature contains it.
FOLLOWING_DRAFT_PILOTS = (Pilot("features", 1), _EDGES, Pilot("guided", 9, step=3, k=1.0))
FOLLOWING_PILOTS = (
    Pilot("features", 1),
    _EDGES,
    Pilot("features", 12, step=3, with_position=True),
    Pilot("guided", 9, step=3, k=1.0),
    Pilot("color", 4, k=1.0),
)

_LARGE_RADIUS = 18
"""Windows of a larger radius are left out where they would cover the whole image."""

_BATCH_PIXELS = 1 << 14
_SMALL_BATCH_PIXELS = 1 << 13
"""Pixels of a step, at most. The small batch is enough for the pilots of draft, and beside a previous frame;
with more of them the rims of lamps, few pixels, come out worse."""

STEPS_OF_ONE_NETWORK = 240
"""Steps of one network by itself: after fewer, walls are more blotched. The mean of several needs fewer."""

_FEW_PIXELS = 32 * 32
_STEPS_ON_FEW_PIXELS = 40
"""Images of fewer pixels have no more steps, or their network would learn the noise of those pixels."""


@dataclass(frozen=True)
class Recipe:
    """What a preset computes.

    A network of so many ``members`` blends the ``pilots`` and is trained for ``steps`` steps of
    ``batch_pixels`` pixels. ``all_samples``: the pilots are computed from all samples, too.
    """

    pilots: tuple[Pilot, ...]
    steps: int
    batch_pixels: int = _BATCH_PIXELS
    members: int = 1
    all_samples: bool = True


RECIPES: dict[Preset, Recipe] = {
    "draft": Recipe(DRAFT_PILOTS, 80, _SMALL_BATCH_PIXELS, all_samples=False),
    "balanced": Recipe(BALANCED_PILOTS, 160, members=2),
    "final": Recipe(FINAL_PILOTS, 240, members=6),
}


def recipe_of(settings: FitSettings, *, following: bool) -> Recipe:
    """Return the recipe of the settings' preset, or the one for frames that are ``following`` another."""
    recipe = RECIPES[settings.preset]
    if following:
        # The previous frame moved into place has no counterpart among the pilots of all samples.
        pilots = FOLLOWING_DRAFT_PILOTS if settings.preset == "draft" else FOLLOWING_PILOTS
        return Recipe(pilots, STEPS_OF_ONE_NETWORK, _SMALL_BATCH_PIXELS, all_samples=False)
    if settings.time_budget_s is not None:
        if recipe.members > 1:
            # The time is better spent on the steps of one network.
            recipe = replace(recipe, members=1, steps=STEPS_OF_ONE_NETWORK)
        # Those of draft are enough by themselves where there is no time for others.
        others = tuple(pilot for pilot in recipe.pilots if pilot not in DRAFT_PILOTS)
        recipe = replace(recipe, pilots=(*DRAFT_PILOTS, *others))
    return recipe


def pilots_for_size(pilots: tuple[Pilot, ...], width: int, height: int) -> tuple[Pilot, ...]:
    """Return those of the pilots for which an image is large enough, in their order."""
    # One model of first order cannot stand for a whole image.
    largest = max(_LARGE_RADIUS, (max(width, height) - 1) // 2)
    return tuple(pilot for pilot in pilots if pilot.radius <= largest)


def steps_for_size(steps: int, width: int, height: int) -> int:
    """Return how many of the steps an image has enough pixels for."""
    return min(steps, _STEPS_ON_FEW_PIXELS) if width * height < _FEW_PIXELS else steps
