"""What the translator hands to the renderer: a Tungsten scene in Mitsuba's terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tungsten_dip.scene.types import FilterName, PathTracer


@dataclass(frozen=True)
class TranslatedScene:
    """A scene for `mitsuba.load_dict`, and what Tungsten's integrator takes beyond it.

    ``scene`` is a dictionary of type "scene" with one sensor and no integrator. The film's size is the
    picture's; its reconstruction filter and the sensor's sampler are not used.

    ``albedo`` maps the id of every BSDF that a shape carries (the outermost one: a "twosided", "mask" or
    "tungsten_bump" around it counts) to the texture that Tungsten calls the albedo of that BSDF, as
    `mitsuba.load_dict` takes it. The id of a BSDF is its key in ``scene``.

    ``reconstruction_filter`` is Tungsten's, whose samples are distributed by the filter instead of weighted
    by it. ``pixel_center`` is where the filter is centred in a pixel: 0.5, but 0 for Tungsten's thin lens.
    ``lens`` holds what the integrator is given of a thin lens beyond the sensor.
    """

    scene: Mapping[str, Any]
    albedo: Mapping[str, Mapping[str, Any]]
    integrator: PathTracer = field(default_factory=PathTracer)
    reconstruction_filter: FilterName = "tent"
    pixel_center: float = 0.5
    lens: Mapping[str, float] = field(default_factory=dict)
