"""Tungsten's lights that no ray can hit: points, and what surrounds the scene.

Their ``sampling_weight`` is what mitsuba_ext/tungsten_lights.hpp expects.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from tungsten_dip.hosts.mitsuba.scene_builder import Node, SceneBuilder, constant, transform
from tungsten_dip.hosts.mitsuba.sky import sky_pixels
from tungsten_dip.hosts.mitsuba.textures import bitmap_pixels, mean_value, shines, texture_node
from tungsten_dip.scene import types as ts
from tungsten_dip.scene.types import Matrix

Surrounding = ts.InfiniteSphere | ts.InfiniteSphereCap | ts.Skydome
"""What lights a scene from infinitely far away."""

# Mitsuba's azimuth in an environment map starts at -z and Tungsten's at -x.
_ENVMAP_AXES = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def point_node(builder: SceneBuilder, primitive: ts.Point) -> Node | None:
    """Return Mitsuba's point light, or None where it does not shine."""
    texture = primitive.emitter
    if texture is None or not shines(builder, primitive):
        return None
    if not isinstance(texture, ts.ConstantTexture):
        raise builder.unsupported(f"a point light with a texture of type {texture.kind}")
    scale = 1.0 / (4.0 * math.pi) if primitive.power is not None else 1.0
    intensity = _scaled(texture.value, scale)
    return {
        "type": "point",
        "position": [float(x) for x in primitive.world_from_local[:3, 3]],
        "intensity": constant(intensity),
        "sampling_weight": max(intensity),
    }


def environment_node(builder: SceneBuilder, primitive: Surrounding) -> Node | None:
    """Return the Mitsuba emitter of a light that surrounds the scene, or None where it does not shine.

    Raises InputError for a texture without counterpart.
    """
    if not shines(builder, primitive):
        return None
    if isinstance(primitive, ts.Skydome):
        return envmap_node(sky_pixels(builder, primitive), np.eye(3))
    texture = primitive.emitter
    assert texture is not None
    if isinstance(primitive, ts.InfiniteSphereCap):
        return _cap(builder, primitive, texture)
    scale = 1.0 / (4.0 * math.pi) if primitive.power is not None else 1.0
    if isinstance(texture, ts.ConstantTexture):
        return _constant_environment(_scaled(texture.value, scale))
    if isinstance(texture, ts.BitmapTexture) and texture.interpolate:
        pixels = bitmap_pixels(builder, texture, "rgb") * (scale * texture.scale)
        return envmap_node(pixels, _rotation(builder, primitive.world_from_local), clamp=texture.clamp)
    raise builder.unsupported(
        f"an infinite_sphere with a texture of type {texture.kind} (or not interpolated)"
    )


def default_environment() -> Node:
    """Return the white sky that Tungsten adds to a scene without lights."""
    return _constant_environment((1.0, 1.0, 1.0))


def together(surroundings: Sequence[tuple[Any, Surrounding]]) -> Any:
    """Return one emitter for all lights around the scene, since Mitsuba supports only one."""
    if len(surroundings) == 1:
        return surroundings[0][0]
    weight = sum(light.sampling_weight() for light, _ in surroundings)
    node: Node = {"type": "tungsten_environments", "sampling_weight": weight}
    for number, (light, primitive) in enumerate(surroundings):
        node |= {
            f"light_{number}": light,
            f"cap_{number}": isinstance(primitive, ts.InfiniteSphereCap),
            f"sampled_{number}": primitive.sample,
        }
    return node


def envmap_node(
    pixels: npt.NDArray[np.floating[Any]], rotation: npt.NDArray[np.float64], *, clamp: bool = False
) -> Node:
    """Return an environment map of latitude-longitude texels, row 0 about local +y.

    Both renderers interpolate between texels, but Mitsuba's outermost rows lie on the poles and Tungsten's
    half a texel off. With a row for every half texel Mitsuba's map goes through all of Tungsten's.
    """
    above, below = (pixels[:1], pixels[-1:]) if clamp else (pixels[-1:], pixels[:1])
    padded = np.concatenate([above, pixels, below])
    rows = np.empty((2 * len(pixels) + 1, *pixels.shape[1:]))
    rows[1::2] = pixels
    rows[0::2] = 0.5 * (padded[:-1] + padded[1:])
    to_world = np.eye(4)
    to_world[:3, :3] = rotation @ _ENVMAP_AXES
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(rows, dtype=np.float32)),
        "to_world": transform(to_world),
        "sampling_weight": _irradiance(pixels),
    }


def _irradiance(pixels: npt.NDArray[np.floating[Any]]) -> float:
    """Return about the irradiance of a surface that faces the bright side of what surrounds it.

    ``pixels`` are those of `envmap_node`. A quarter of the light from all directions and half of its vector
    sum are the cosine's first two terms (Ramamoorthi and Hanrahan, "An Efficient Representation for
    Irradiance Environment Maps", SIGGRAPH 2001); both are exact for a sky of one colour.
    """
    rows, columns = pixels.shape[:2]
    polar = (np.arange(rows) + 0.5) * math.pi / rows
    azimuth = (np.arange(columns) + 0.5) * 2.0 * math.pi / columns
    solid_angles = np.sin(polar) * (math.pi / rows) * (2.0 * math.pi / columns)
    light = np.maximum(pixels, 0.0)
    total = np.einsum("rck,r->k", light, solid_angles)
    vector = [
        np.einsum("rck,r->k", light, solid_angles * np.cos(polar)),
        np.einsum("rck,r,c->k", light, solid_angles * np.sin(polar), np.cos(azimuth)),
        np.einsum("rck,r,c->k", light, solid_angles * np.sin(polar), np.sin(azimuth)),
    ]
    return float((0.25 * total + 0.5 * np.linalg.norm(vector, axis=0)).max())


def _constant_environment(radiance: ts.Vec3) -> Node:
    return {
        "type": "constant",
        "radiance": constant(radiance),
        "sampling_weight": math.pi * max(radiance),
    }


def _cap(builder: SceneBuilder, primitive: ts.InfiniteSphereCap, texture: ts.Texture) -> Node | None:
    if primitive.cap_angle == 0.0:
        return None
    angle = math.radians(primitive.cap_angle)
    shown = math.pi * math.sin(min(angle, 0.5 * math.pi)) ** 2  # to a surface that faces it
    solid_angle = 4.0 * math.pi * math.sin(angle / 2.0) ** 2
    scale = 1.0 / solid_angle if primitive.power is not None else 1.0
    # Tungsten takes the one colour at UV (0, 0), where its blade textures have theirs, whatever they cover.
    if isinstance(texture, ts.BladeTexture):
        texture = ts.ConstantTexture(value=texture.value)
    return {
        "type": "tungsten_cap",
        "direction": [float(x) for x in primitive.world_from_local[:3, 1]],
        "cap_angle": angle,
        "radiance": texture_node(builder, texture, "rgb", scale=scale),
        "sampling_weight": shown * scale * mean_value(builder, texture),
    }


def _rotation(builder: SceneBuilder, matrix: Matrix) -> npt.NDArray[np.float64]:
    axes = np.asarray(matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0))
    if not np.allclose(axes.T @ axes, np.eye(3), atol=1e-3):
        raise builder.unsupported("a sheared transform")
    return axes


def _scaled(value: ts.Vec3, scale: float) -> ts.Vec3:
    return (value[0] * scale, value[1] * scale, value[2] * scale)
