"""Translates a Tungsten scene into Mitsuba's terms, so that both renderers show the same picture.

What agrees, what is approximated (and by how much) and what is refused stands in ``docs/mitsuba-host.md``.
"""

from __future__ import annotations

import logging
from typing import Any

from tungsten_dip.hosts.mitsuba.emitters import (
    Surrounding,
    default_environment,
    environment_node,
    point_node,
    together,
)
from tungsten_dip.hosts.mitsuba.scene_builder import SceneBuilder, load
from tungsten_dip.hosts.mitsuba.sensor import lens_of_integrator, sensor_node
from tungsten_dip.hosts.mitsuba.shapes import add_shapes
from tungsten_dip.hosts.mitsuba.translated_scene import TranslatedScene
from tungsten_dip.scene import types as ts

_LOG = logging.getLogger(__name__)

_FROM_BOTH_ENDS = (ts.BidirectionalPathTracer, ts.MultiplexedMlt, ts.ReversibleJumpMlt)


def translate(scene: ts.Scene) -> TranslatedScene:
    """Return the scene for Mitsuba's variant scalar_rgb; call it within `mitsuba_variant`.

    Raises InputError, one line that names the construct, for what Mitsuba cannot show as Tungsten does, and
    for meshes and images that cannot be read.
    """
    builder = SceneBuilder(scene)
    try:
        return _translated(builder, scene)
    except RuntimeError as error:
        raise builder.refused(error) from None


def _translated(builder: SceneBuilder, scene: ts.Scene) -> TranslatedScene:
    integrator = _path_tracer(builder, scene.integrator)
    lights = 0
    surroundings: list[tuple[Any, Surrounding]] = []
    for number, primitive in enumerate(scene.primitives):
        builder.place = f"primitives[{number}]" + (f' "{primitive.name}"' if primitive.name else "")
        match primitive:
            case ts.Point():
                node = point_node(builder, primitive)
            case ts.InfiniteSphere() | ts.InfiniteSphereCap() | ts.Skydome():
                node = environment_node(builder, primitive)
                if node is not None:
                    surroundings.append((load(node), primitive))
                continue
            case _:
                lights += add_shapes(builder, primitive)
                continue
        if node is not None:
            builder.add("emitter", node)
            lights += 1
    _log_replacement(builder, scene.integrator, lights + len(surroundings))
    if surroundings:
        builder.add("emitter", together(surroundings))
    elif not lights:
        builder.add("emitter", default_environment())
    builder.add("sensor", sensor_node(builder, scene.camera))
    return TranslatedScene(
        builder.scene,
        builder.albedo,
        integrator,
        scene.camera.reconstruction_filter,
        scene.camera.pixel_center,
        lens_of_integrator(builder, scene.camera),
    )


def _log_replacement(builder: SceneBuilder, integrator: ts.Integrator, lights: int) -> None:
    """Log that another integrator is replaced, if it is: as a warning where the picture differs.

    Tungsten's paths from several lights have weights that sum to less than 1: those that hit a light ignore
    how likely that light is chosen (`LightPath::bdptWeightedPathEmission`), and `reversible_jump_mlt` starts
    from the first light alone.
    """
    if integrator.kind == ts.PathTracer.kind:
        return
    bidirectional = isinstance(integrator, _FROM_BOTH_ENDS) or (
        isinstance(integrator, ts.KelemenMlt) and integrator.bidirectional
    )
    if bidirectional and lights > 1:
        _LOG.warning(
            "%s: a path_tracer renders in place of %s, which in Tungsten is too dark with several lights",
            builder.source.path,
            integrator.kind,
        )
    else:
        _LOG.info("%s: a path_tracer renders in place of %s", builder.source.path, integrator.kind)


def _path_tracer(builder: SceneBuilder, integrator: ts.Integrator) -> ts.PathTracer:
    """Return the path tracer that converges to the picture of an integrator."""
    if isinstance(integrator, ts.PathTracer) and integrator.kind == ts.PathTracer.kind:
        return integrator
    if isinstance(integrator, ts.LightTracer):
        raise builder.unsupported("a light_tracer, which shows no mirrors,")
    kept = {}
    if isinstance(integrator, ts.PathTracer | ts.PhotonMap):
        kept = {name: getattr(integrator, name) for name in ("low_order_scattering", "include_surfaces")}
    return ts.PathTracer(
        **kept,
        min_bounces=integrator.min_bounces,
        max_bounces=integrator.max_bounces,
        enable_consistency_checks=integrator.enable_consistency_checks,
        enable_two_sided_shading=integrator.enable_two_sided_shading,
    )
