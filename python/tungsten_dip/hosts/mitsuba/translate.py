"""Translates a Tungsten scene into Mitsuba's terms, so that both renderers show the same picture.

What agrees, what is approximated (and by how much) and what is refused stands in ``docs/mitsuba-host.md``.
"""

from __future__ import annotations

from tungsten_dip.hosts.mitsuba.emitters import default_environment, environment_node, point_node
from tungsten_dip.hosts.mitsuba.sensor import pixel_center, sensor_node
from tungsten_dip.hosts.mitsuba.shapes import add_shapes
from tungsten_dip.hosts.mitsuba.translated import TranslatedScene
from tungsten_dip.hosts.mitsuba.translation import Translation
from tungsten_dip.scene import types as ts


def translate(scene: ts.Scene) -> TranslatedScene:
    """Return the scene for Mitsuba's variant scalar_rgb; call it within `mitsuba_variant`.

    Raises InputError, one line that names the construct, for what Mitsuba cannot show as Tungsten does, and
    for meshes and images that cannot be read.
    """
    t = Translation(scene)
    if not isinstance(scene.integrator, ts.PathTracer):
        raise t.unsupported(f"an integrator of type {scene.integrator.kind}")
    lights = surroundings = 0
    for number, primitive in enumerate(scene.primitives):
        t.place = f"primitives[{number}]" + (f' "{primitive.name}"' if primitive.name else "")
        match primitive:
            case ts.Point():
                node = point_node(t, primitive)
            case ts.InfiniteSphere() | ts.InfiniteSphereCap() | ts.Skydome():
                node = environment_node(t, primitive)
                surroundings += node is not None
                if surroundings > 1:
                    raise t.unsupported("more than one light that surrounds the scene")
            case _:
                lights += add_shapes(t, primitive)
                continue
        if node is not None:
            t.add("emitter", node)
            lights += 1
    if not lights:
        t.add("emitter", default_environment())
    t.scene["sensor"] = sensor_node(t, scene.camera)
    return TranslatedScene(
        t.scene,
        t.albedo,
        scene.integrator,
        scene.camera.reconstruction_filter,
        pixel_center(scene.camera),
    )
