"""Tungsten's finite primitives as Mitsuba's shapes.

Quads and cubes become meshes, since Mitsuba's have another size or parameterisation; spheres, disks and
cylinders are turned so that their UV agree. Of a transform Tungsten keeps what its primitives need (the
largest scale of a sphere, say), and so does this.
"""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from tungsten_dip.hosts.mitsuba.bsdfs import BentShape, bsdf_object, height_map
from tungsten_dip.hosts.mitsuba.curves import curve_shapes
from tungsten_dip.hosts.mitsuba.media import medium_object
from tungsten_dip.hosts.mitsuba.scene_builder import Node, SceneBuilder, transform
from tungsten_dip.hosts.mitsuba.textures import UV, is_constant, mean_value, shines, texture_node
from tungsten_dip.scene import types as ts
from tungsten_dip.scene.meshes import mesh_geometry
from tungsten_dip.scene.types import Matrix

_Array = npt.NDArray[np.float64]

_LOG = logging.getLogger(__name__)

# From Mitsuba's UV to Tungsten's.
_DISK_UV = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_CYLINDER_UV = np.array([[-1.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


_BENT_SHAPES: dict[type[ts.Primitive], BentShape] = {ts.Mesh: "mesh", ts.Cube: "cube", ts.Quad: "quad"}

_LEAST_UV_AREA = 1e-6
"""Twice the area in UV of a triangle below which Tungsten computes no tangents of it."""


def add_shapes(builder: SceneBuilder, primitive: ts.Primitive) -> bool:
    """Add the shapes that stand for one primitive, and return whether it shines.

    Raises InputError for what has no counterpart.
    """
    for shape in _shapes(builder, primitive):
        builder.add("shape", shape)
    return shines(builder, primitive)


def _shapes(builder: SceneBuilder, primitive: ts.Primitive) -> list[Any]:
    match primitive:
        case ts.Mesh():
            return _mesh(builder, primitive)
        case ts.Quad():
            return [_quad(builder, primitive)]
        case ts.Cube():
            return [_cube(builder, primitive)]
        case ts.Sphere():
            return [_sphere(builder, primitive)]
        case ts.Disk():
            return [_disk(builder, primitive)]
        case ts.Cylinder():
            return _cylinder(builder, primitive)
        case ts.Curves():
            return curve_shapes(builder, primitive)
        case ts.Instances():
            return _instances(builder, primitive)
    raise builder.unsupported(f"a primitive of type {primitive.kind}")


def emission_node(builder: SceneBuilder, primitive: ts.Primitive, area: float, uv: Matrix = UV) -> Node:
    """Return {"emitter": ...} for a primitive of this area that shines, else {}."""
    texture = primitive.emitter
    if texture is None or not shines(builder, primitive) or area == 0.0:
        return {}
    scale = 1.0 / (math.pi * area) if primitive.power is not None else 1.0
    if isinstance(primitive, ts.Sphere) and not is_constant(texture):
        raise builder.unsupported("a shining sphere with a texture")
    return {
        "emitter": {
            "type": "tungsten_area",
            "radiance": texture_node(builder, texture, "rgb", uv, scale),
            "sampling_weight": scale * mean_value(builder, texture),
        }
    }


def _bsdf_and_media(builder: SceneBuilder, primitive: ts.Primitive, bsdf: ts.Bsdf, uv: Matrix = UV) -> Node:
    """What a shape needs beside its geometry and its light: its BSDF and media."""
    surface = bsdf_object(builder, bsdf, uv, shape=_BENT_SHAPES.get(type(primitive)))
    node: Node = {surface.id(): surface}  # Mitsuba renames what it finds under another name
    if primitive.int_medium is not None:
        node["interior"] = medium_object(builder, primitive.int_medium)
    if primitive.ext_medium is not None:
        node["exterior"] = medium_object(builder, primitive.ext_medium)
    return node


def _mesh(builder: SceneBuilder, primitive: ts.Mesh) -> list[Any]:
    mesh = mesh_geometry(primitive)
    matrix = primitive.world_from_local
    positions = mesh.positions @ matrix[:3, :3].T + matrix[:3, 3]
    # The inverse scale comes last in Tungsten, which bends normals under a rotation with an uneven scale.
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    # What is flattened has no such normals (in Tungsten they are NaN), but those of its faces.
    is_smooth = primitive.smooth and lengths.all()
    normals = mesh.normals @ matrix[:3, :3].T / lengths**2 if is_smooth else None
    corners = positions[mesh.triangles]
    edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = float(0.5 * np.linalg.norm(np.cross(*edges), axis=1).sum())
    if area == 0.0:
        return []
    emission = emission_node(builder, primitive, area)
    materials = np.clip(mesh.materials, 0, len(primitive.bsdf) - 1)
    parts = [(bsdf, materials == number) for number, bsdf in enumerate(primitive.bsdf)]
    if any(height_map(bsdf) for bsdf in primitive.bsdf):
        first, second = (mesh.uvs[mesh.triangles[:, i]] - mesh.uvs[mesh.triangles[:, 0]] for i in (1, 2))
        flat = abs(first[:, 0] * second[:, 1] - second[:, 0] * first[:, 1]) < _LEAST_UV_AREA
        bare = [(replace(bsdf, bump=None), part & flat) for bsdf, part in parts]
        parts = [*((bsdf, part & ~flat) for bsdf, part in parts), *bare]
    shapes = []
    for bsdf, part in parts:
        if not part.any():
            continue
        triangles = mesh.triangles[part]
        node = {**_bsdf_and_media(builder, primitive, bsdf), **emission}
        if emission and normals is not None:
            faces = _triangles({}, positions, triangles, mesh.uvs)
            node["emitter"] = {**emission["emitter"], "faces": faces}
        shapes.append(_triangles(node, positions, triangles, mesh.uvs, normals))
    return shapes


def _quad(builder: SceneBuilder, primitive: ts.Quad) -> Any:
    centre, (edge_x, _, edge_z) = primitive.world_from_local[:3, 3], primitive.world_from_local[:3, :3].T
    lengths = np.linalg.norm(edge_x), np.linalg.norm(edge_z)
    if abs(edge_x @ edge_z) > 1e-2 * lengths[0] * lengths[1]:
        raise builder.unsupported("a sheared quad")
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    positions = centre + (uv[:, :1] - 0.5) * edge_x + (uv[:, 1:] - 0.5) * edge_z
    triangles = np.array([[0, 2, 1], [0, 3, 2]])
    node = _bsdf_and_media(builder, primitive, primitive.bsdf)
    node |= emission_node(builder, primitive, float(lengths[0] * lengths[1]))
    return _triangles(node, positions, triangles, uv)


def _cube(builder: SceneBuilder, primitive: ts.Cube) -> Any:
    centre, rotation, scale = _parts(builder, primitive.world_from_local)
    corner_uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    positions: list[_Array] = []
    triangles: list[npt.NDArray[Any]] = []
    uv: list[_Array] = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            face = np.empty((4, 3))
            face[:, axis] = side
            face[:, (axis + 1) % 3] = corner_uv[:, 0] - 0.5
            face[:, (axis + 2) % 3] = corner_uv[:, 1] - 0.5
            outward = np.array([[0, 1, 2], [0, 2, 3]])
            triangles.append((outward if side > 0 else outward[:, ::-1]) + 4 * len(positions))
            positions.append(face)
            uv.append(corner_uv)
    # A rotation that mirrors turns the faces inside out; Tungsten's normals stay outside.
    indices = np.concatenate(triangles)
    if np.linalg.det(rotation) < 0.0:
        indices = indices[:, ::-1]
    area = 2.0 * float(scale[0] * scale[1] + scale[1] * scale[2] + scale[2] * scale[0])
    node = _bsdf_and_media(builder, primitive, primitive.bsdf) | emission_node(builder, primitive, area)
    points = centre + (np.concatenate(positions) * scale) @ rotation.T
    return _triangles(node, points, indices, np.concatenate(uv))


def _sphere(builder: SceneBuilder, primitive: ts.Sphere) -> Node:
    centre, rotation, scale = _parts(builder, primitive.world_from_local)
    radius = float(scale.max())
    # Half a turn about z brings Mitsuba's azimuth, which starts at +x, to Tungsten's, which starts at -x.
    axes = radius * (rotation @ np.diag([-1.0, -1.0, 1.0]))
    return {
        "type": "sphere",
        "to_world": transform(_affine(axes, centre)),
        # Mirrored, Mitsuba's sphere would be one that is seen from within.
        "flip_normals": bool(np.linalg.det(rotation) < 0.0),
        **_bsdf_and_media(builder, primitive, primitive.bsdf),
        **emission_node(builder, primitive, 4.0 * math.pi * radius**2),
    }


def _disk(builder: SceneBuilder, primitive: ts.Disk) -> Node:
    centre, rotation, scale = _parts(builder, primitive.world_from_local)
    radius = float(max(scale[0], scale[2]))
    emission = emission_node(builder, primitive, math.pi * radius**2, _DISK_UV)
    if emission and primitive.cone_angle != 90.0:
        raise builder.unsupported("a shining disk with a cone_angle")
    tangent, bitangent = _tangent_frame(rotation[:, 1])
    axes = radius * np.stack([-bitangent, -tangent, rotation[:, 1]], axis=1)
    return {
        "type": "disk",
        "to_world": transform(_affine(axes, centre)),
        **_bsdf_and_media(builder, primitive, primitive.bsdf, _DISK_UV),
        **emission,
    }


def _cylinder(builder: SceneBuilder, primitive: ts.Cylinder) -> list[Node]:
    centre, rotation, scale = _parts(builder, primitive.world_from_local)
    radius, height = 0.5 * float(max(scale[0], scale[2])), float(scale[1])
    x, y, z = rotation.T
    # Tungsten counts the caps whether they are there or not.
    area = 2.0 * math.pi * radius * (radius + height)
    emission = emission_node(builder, primitive, area, _CYLINDER_UV)
    if emission and not primitive.capped:
        raise builder.unsupported("a shining cylinder without caps")
    side = _affine(np.stack([-radius * x, radius * z, height * y], axis=1), centre - 0.5 * height * y)
    shapes: list[Node] = [
        {
            "type": "cylinder",
            "to_world": transform(side),
            **_bsdf_and_media(builder, primitive, primitive.bsdf, _CYLINDER_UV),
            **emission,
        }
    ]
    if primitive.capped:
        if not _is_uniform(primitive):
            raise builder.unsupported("a texture on a cylinder with caps")
        for sign in (-1.0, 1.0):
            axes = radius * np.stack([x, -sign * z, sign * y], axis=1)
            shapes.append(
                {
                    "type": "disk",
                    "to_world": transform(_affine(axes, centre + 0.5 * sign * height * y)),
                    **_bsdf_and_media(builder, primitive, primitive.bsdf),
                    **emission,
                }
            )
    return shapes


def _instances(builder: SceneBuilder, primitive: ts.Instances) -> list[Node]:
    if primitive.file_a is not None or primitive.file_b is not None:
        raise builder.unsupported("a file of instances")
    groups = []
    for master in primitive.masters:
        if isinstance(master, ts.Instances):
            raise builder.unsupported("instances within instances")
        if not isinstance(master, ts.Quad | ts.Disk):
            _LOG.warning(
                "%s: %s: Tungsten lights instances of a %s from the wrong places; here they are right",
                builder.source.path,
                builder.place,
                master.kind,
            )
        # Masters do not shine, and the media are those of the instances.
        bare = replace(
            master,
            emission=None,
            power=None,
            int_medium=primitive.int_medium,
            ext_medium=primitive.ext_medium,
        )
        shapes = {f"shape_{number}": shape for number, shape in enumerate(_shapes(builder, bare))}
        groups.append(builder.add("shapegroup", {"type": "shapegroup", **shapes}))
    _, rotation, _ = _parts(builder, primitive.world_from_local)
    nodes = []
    for placement in primitive.instances:
        origin, turn, _ = _parts(builder, placement.world_from_local)
        place = (primitive.world_from_local @ np.append(origin, 1.0))[:3]
        to_world = transform(_affine(rotation @ turn, place))
        nodes.append({"type": "instance", "shapegroup": groups[placement.id], "to_world": to_world})
    return nodes


def _is_uniform(primitive: ts.Cylinder) -> bool:
    textures = [value for value in vars(primitive.bsdf).values() if isinstance(value, ts.Texture)]
    return all(is_constant(x) for x in [*textures, *filter(None, [primitive.emitter])])


def _triangles(
    node: Node,
    positions: _Array,
    triangles: npt.NDArray[Any],
    uv: npt.NDArray[Any],
    normals: _Array | None = None,
) -> Any:
    """Return a mesh with the vertices that its triangles use."""
    used, indices = np.unique(triangles, return_inverse=True)
    indices = indices.reshape(-1, 3)
    vertices = positions[used].astype(np.float32)
    if "emitter" in node:
        first, second = (vertices[indices[:, corner]] - vertices[indices[:, 0]] for corner in (1, 2))
        with np.errstate(over="ignore", invalid="ignore"):
            areas = np.linalg.norm(np.cross(first, second), axis=1)
        if not areas.any():
            # Mitsuba refuses it. A small light far from the origin has no area in float32 either.
            node = {name: value for name, value in node.items() if name != "emitter"}
    props = mi.Properties()
    for name, value in node.items():
        props[name] = mi.load_dict(value) if isinstance(value, dict) else value
    if normals is None:
        props["face_normals"] = True
    mesh = mi.Mesh("mesh", len(used), len(triangles), props, normals is not None, True)
    params = mi.traverse(mesh)
    params["faces"] = indices.astype(np.uint32).ravel()
    params["vertex_positions"] = vertices.ravel()
    if normals is not None:
        params["vertex_normals"] = normals[used].astype(np.float32).ravel()
    params["vertex_texcoords"] = uv[used].astype(np.float32).ravel()
    params.update()
    return mesh


def _parts(builder: SceneBuilder, matrix: Matrix) -> tuple[_Array, _Array, _Array]:
    """Return position, unit axes (as columns) and their lengths, as Tungsten takes a matrix apart."""
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    known = scale > 0
    axes = np.empty((3, 3))
    axes[:, known] = matrix[:3, :3][:, known] / scale[known]
    # An axis without length may point anywhere that the others do not.
    axes[:, ~known] = np.linalg.svd(axes[:, known])[0][:, known.sum() :]
    if abs(axes.T @ axes - np.diag(np.diagonal(axes.T @ axes))).max() > 1e-3:
        raise builder.unsupported("a sheared transform")
    return matrix[:3, 3], axes, scale


def _affine(axes: _Array, origin: _Array) -> Matrix:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, origin
    return matrix


def _tangent_frame(n: _Array) -> tuple[_Array, _Array]:
    """Return two tangents (Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 2017)."""
    sign = math.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    tangent = np.array([1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]])
    return tangent, np.array([b, sign + n[1] * n[1] * a, -n[1]])
