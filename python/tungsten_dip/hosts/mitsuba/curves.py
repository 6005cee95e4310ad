"""Tungsten's curves as Mitsuba's: every quadratic segment becomes a cubic B-spline that is the same curve."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from tungsten_dip.hosts.mitsuba.bsdfs import bsdf_object
from tungsten_dip.hosts.mitsuba.scene_builder import SceneBuilder
from tungsten_dip.hosts.mitsuba.textures import is_constant, shines
from tungsten_dip.scene import types as ts
from tungsten_dip.scene.meshes import curve_geometry

_Array = npt.NDArray[np.float64]


def curve_shapes(builder: SceneBuilder, primitive: ts.Curves) -> list[Any]:
    """Return the shape of all curves of a primitive.

    Raises InputError for ribbons, and for surfaces that need UV or a normal that only Tungsten has.
    """
    faces_viewer = primitive.mode == "bcsdf_cylinder"
    if primitive.mode == "ribbon":
        raise builder.unsupported("curves of mode ribbon")
    if faces_viewer and not isinstance(primitive.bsdf, ts.HairBsdf):
        raise builder.unsupported(f"a BSDF of type {primitive.bsdf.kind} on curves of mode bcsdf_cylinder")
    if shines(builder, primitive):
        raise builder.unsupported("shining curves")
    if primitive.int_medium is not None or primitive.ext_medium is not None:
        raise builder.unsupported("curves with a medium")
    textures = [value for value in vars(primitive.bsdf).values() if isinstance(value, ts.Texture)]
    if not all(is_constant(texture) for texture in textures):
        raise builder.unsupported("a texture on curves")

    curves = curve_geometry(primitive)
    nodes = curves.nodes.astype(np.float64)
    matrix = primitive.world_from_local
    nodes[:, :3] = nodes[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]
    nodes[:, 3] *= np.linalg.norm(matrix[:3, :3], axis=0).mean()
    starts = np.concatenate([[0], curves.ends[:-1]])
    drawn = _drawn(len(curves.ends), primitive.subsample)
    firsts = [np.arange(start, end - 2) for start, end in zip(starts[drawn], curves.ends[drawn], strict=True)]
    first = np.concatenate(firsts) if firsts else np.empty(0, np.int64)
    if not len(first):
        return []
    control_points = cubic_from_quadratic(nodes[first], nodes[first + 1], nodes[first + 2])
    surface = bsdf_object(builder, primitive.bsdf, faces_viewer=faces_viewer)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "curves.txt"
        # A line for every control point, an empty one after every segment.
        np.savetxt(path, control_points.reshape(-1, 16), fmt=4 * "%.9g %.9g %.9g %.9g\n")
        return [mi.load_dict({"type": "bsplinecurve", "filename": str(path), surface.id(): surface})]


def cubic_from_quadratic(p0: _Array, p1: _Array, p2: _Array) -> _Array:
    """Return the control points of the cubic B-splines that are these quadratic ones.

    The points have shape (segments, channels), the result (segments, 4, channels).
    """
    square, linear, start = 0.5 * p0 - p1 + 0.5 * p2, p1 - p0, 0.5 * (p0 + p1)
    second = start - square / 3.0
    first, third = second + square - linear, second + square + linear
    return np.stack([first, second, third, first - 3.0 * second + 3.0 * third], axis=1)


def _drawn(count: int, subsample: float) -> npt.NDArray[np.bool_]:
    """Return which curves Tungsten keeps; it draws them with PCG32 (O'Neill 2014) from a fixed seed."""
    if subsample == 0.0:
        return np.ones(count, np.bool_)
    state, kept = 0xBA5EBA11, np.empty(count, np.bool_)
    for number in range(count):
        shifted = (((state >> 18) ^ state) >> 27) & 0xFFFFFFFF
        turn = state >> 59
        state = (state * 6364136223846793005 + 1) & 0xFFFFFFFFFFFFFFFF
        bits = ((shifted >> turn) | (shifted << (-turn & 31))) & 0xFFFFFFFF
        kept[number] = (bits >> 9) / 2**23 >= subsample
    return kept
