"""Tungsten's participating media as Mitsuba's."""

from __future__ import annotations

from typing import Any

from tungsten_dip.hosts.mitsuba.translation import Node, Translation, constant
from tungsten_dip.scene import types as ts

_ENDLESS = 1024
"""Tungsten's own bound on the bounces of a medium; paths beyond it bring no light that could be seen."""


def medium_object(t: Translation, medium: ts.Medium) -> Any:
    """Return the Mitsuba medium.

    Raises InputError for what has no counterpart.
    """
    key = ("medium", medium)
    found = t.made(key)
    if found is not None:
        return found
    named = f'medium "{medium.name}"' if medium.name else f"medium of type {medium.kind}"
    outer, t.place = t.place, f"{t.place}, {named}"
    built = t.add("medium", _node(t, medium))
    t.place = outer
    return t.remember(key, built)


def _node(t: Translation, medium: ts.Medium) -> Node:
    if not isinstance(medium, ts.HomogeneousMedium):
        raise t.unsupported(f"a medium of type {medium.kind}")
    if not isinstance(medium.transmittance, ts.ExponentialTransmittance):
        raise t.unsupported(f"a transmittance of type {medium.transmittance.kind}")
    if medium.max_bounces < min(t.source.integrator.max_bounces, _ENDLESS):
        raise t.unsupported(f"a medium with fewer bounces ({medium.max_bounces}) than the integrator")
    sigma_a, sigma_s = ([medium.density * s for s in sigma] for sigma in (medium.sigma_a, medium.sigma_s))
    sigma_t = (sigma_a[0] + sigma_s[0], sigma_a[1] + sigma_s[1], sigma_a[2] + sigma_s[2])
    r, g, b = (s / total if total > 0.0 else 0.0 for s, total in zip(sigma_s, sigma_t, strict=True))
    return {
        "type": "homogeneous",
        "sigma_t": {"type": "constvolume", "value": constant(sigma_t)},
        "albedo": {"type": "constvolume", "value": constant((r, g, b))},
        "phase": _phase(t, medium.phase_function),
    }


def _phase(t: Translation, phase: ts.PhaseFunction) -> Node:
    match phase:
        case ts.IsotropicPhaseFunction():
            return {"type": "isotropic"}
        case ts.HenyeyGreensteinPhaseFunction():
            return {"type": "hg", "g": phase.g}
        case ts.RayleighPhaseFunction():
            return {"type": "rayleigh"}
    raise t.unsupported(f"a phase function of type {phase.kind}")
