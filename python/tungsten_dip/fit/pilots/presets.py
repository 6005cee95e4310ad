"""The pilots of every preset, and of frames that follow another."""

from __future__ import annotations

from tungsten_dip.fit.network.layout import Pilot
from tungsten_dip.fit.pilots.surfaces import EDGES_RADIUS

_EDGES = Pilot("edges", EDGES_RADIUS)

# Small windows keep detail, large ones average out the remaining noise; guided ones keep shadows and
# reflections, which no feature contains; a regression on the position follows gradients. Within a time budget
# the first ones are computed, so that cheap ones come first. Errors are relative to the last one that is
# computed, or to the median.
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

# Enough beside the previous frame. The first replaces it where it has no value.
FOLLOWING_DRAFT_PILOTS = (Pilot("features", 1), _EDGES, Pilot("features", 8, step=4, with_position=True))
FOLLOWING_PILOTS = (
    Pilot("features", 1),
    _EDGES,
    Pilot("features", 12, step=3, with_position=True),
    Pilot("guided", 6, step=3, k=2.0),
    Pilot("color", 4, k=1.0),
)
