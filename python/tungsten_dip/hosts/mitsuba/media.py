"""Tungsten's participating media as Mitsuba's."""

from __future__ import annotations

from typing import Any

from tungsten_dip.hosts.mitsuba.scene_builder import Node, SceneBuilder, constant
from tungsten_dip.scene import types as ts

_ENDLESS = 1024
"""Tungsten's own bound on the bounces of a medium; paths beyond it bring no light that could be seen."""


def medium_object(builder: SceneBuilder, medium: ts.Medium) -> Any:
    """Return the Mitsuba medium.

    Raises InputError for what has no counterpart.
    """
    key = ("medium", medium)
    found = builder.made(key)
    if found is not None:
        return found
    named = f'medium "{medium.name}"' if medium.name else f"medium of type {medium.kind}"
    outer, builder.place = builder.place, f"{builder.place}, {named}"
    built = builder.add("medium", _node(builder, medium))
    builder.place = outer
    return builder.remember(key, built)


def _node(builder: SceneBuilder, medium: ts.Medium) -> Node:
    if not isinstance(medium, ts.HomogeneousMedium):
        raise builder.unsupported(f"a medium of type {medium.kind}")
    if not isinstance(medium.transmittance, ts.ExponentialTransmittance):
        raise builder.unsupported(f"a transmittance of type {medium.transmittance.kind}")
    if medium.max_bounces < min(builder.source.integrator.max_bounces, _ENDLESS):
        raise builder.unsupported(f"a medium with fewer bounces ({medium.max_bounces}) than the integrator")
    sigma_a, sigma_s = ([medium.density * s for s in sigma] for sigma in (medium.sigma_a, medium.sigma_s))
    sigma_t = (sigma_a[0] + sigma_s[0], sigma_a[1] + sigma_s[1], sigma_a[2] + sigma_s[2])
    r, g, b = (s / total if total > 0.0 else 0.0 for s, total in zip(sigma_s, sigma_t, strict=True))
    return {
        "type": "homogeneous",
        "sigma_t": {"type": "constvolume", "value": constant(sigma_t)},
        "albedo": {"type": "constvolume", "value": constant((r, g, b))},
        "phase": _phase(builder, medium.phase_function),
    }


def _phase(builder: SceneBuilder, phase: ts.PhaseFunction) -> Node:
    match phase:
        case ts.IsotropicPhaseFunction():
            return {"type": "isotropic"}
        case ts.HenyeyGreensteinPhaseFunction():
            return {"type": "hg", "g": phase.g}
        case ts.RayleighPhaseFunction():
            return {"type": "rayleigh"}
    raise builder.unsupported(f"a phase function of type {phase.kind}")
