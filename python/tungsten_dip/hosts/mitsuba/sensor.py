"""Tungsten's cameras as Mitsuba's.

Both look along +z with +y up, but Mitsuba's x axis points to the left of the picture where Tungsten's points
to the right. Tungsten's field of view is horizontal.
"""

from __future__ import annotations

import numpy as np

from tungsten_dip.hosts.mitsuba.media import medium_object
from tungsten_dip.hosts.mitsuba.scene_builder import Node, SceneBuilder, transform
from tungsten_dip.scene import types as ts

# The rays of Mitsuba's cameras start and end here, in scene units; Tungsten's have no such limits.
_NEAR, _FAR = 1e-4, 1e7


def sensor_node(builder: SceneBuilder, camera: ts.Camera) -> Node:
    """Return the Mitsuba sensor of a camera, with its film.

    Raises InputError for a type of camera or a lens without counterpart.
    """
    builder.place = f"camera of type {camera.kind}"
    if not isinstance(camera, ts.PerspectiveCamera):
        raise builder.unsupported("this camera")
    width, height = camera.resolution
    node: Node = {
        "fov": camera.fov,
        "fov_axis": "x",
        "to_world": transform(_rigid(builder, camera.world_from_local) @ np.diag([-1.0, 1.0, 1.0, 1.0])),
        "near_clip": _NEAR,
        "far_clip": _FAR,
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
    }
    if camera.medium is not None:
        node["medium"] = medium_object(builder, camera.medium)
    if not isinstance(camera, ts.ThinlensCamera) or camera.aperture_size == 0.0:
        return {"type": "perspective", **node}
    lens = {"aperture_radius": camera.aperture_size, "focus_distance": camera.focus_distance}
    return {"type": "thinlens", **node, **lens}


def lens_of_integrator(builder: SceneBuilder, camera: ts.Camera) -> dict[str, float]:
    """Return what the integrator is given of a lens that Mitsuba's sensor does not support.

    Raises InputError for an aperture without counterpart.
    """
    if not isinstance(camera, ts.ThinlensCamera) or camera.aperture_size == 0.0:
        return {}
    builder.place = f"camera of type {camera.kind}"
    lens: dict[str, float] = {}
    match camera.aperture:
        case ts.DiskTexture():
            pass
        case ts.BladeTexture():
            lens = {"lens_blades": camera.aperture.blades, "lens_angle": camera.aperture.angle}
        case _:
            raise builder.unsupported(f"an aperture of type {camera.aperture.kind}")
    if camera.cateye > 0.0:
        lens["lens_radius"] = camera.aperture_size
        lens["diaphragm_distance"] = camera.cateye * camera.plane_distance
    return lens


def _rigid(builder: SceneBuilder, matrix: ts.Matrix) -> ts.Matrix:
    """Return the matrix if it neither scales nor shears, cleaned of rounding to two decimals or more."""
    axes = matrix[:3, :3]
    if not np.allclose(axes.T @ axes, np.eye(3), atol=1e-2):
        raise builder.unsupported("a scale in its transform")
    left, _, right = np.linalg.svd(axes)
    rigid = matrix.copy()
    rigid[:3, :3] = left @ right
    return rigid
