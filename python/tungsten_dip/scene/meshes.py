"""Reads the geometry that scenes name: triangle meshes (.wo3, .obj) and curves (.fiber, .hair).

Counts in a file are checked against its size before anything is allocated, indices against the counts.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tungsten_dip.errors import InputError
from tungsten_dip.scene.types import Curves, Mesh

_LOG = logging.getLogger(__name__)

_Floats = npt.NDArray[np.float32]
_Ints = npt.NDArray[np.int64]

_WO3_VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("uv", "<f4", 2)])
_WO3_TRIANGLE = np.dtype([("vertices", "<u4", 3), ("material", "<i4")])

SPLIT_COSINE = float(np.cos(0.15 * np.pi))
"""Faces that meet more sharply than this (27 degrees) keep an edge when normals are computed."""

MAX_NORMAL_PAIRS = 2**27
"""Pairs of a corner and a vertex at one place that computing normals may visit: bounds the time."""

_NORMAL_PAIRS_AT_ONCE = 2**20
"""Bounds the memory: some 100 MiB."""

_FIBER_MAGIC = bytes([0x80, 0xBF, 0x80, 0x46, 0x49, 0x42, 0x45, 0x52])


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles in the space of their primitive.

    ``positions`` and ``normals`` have shape (vertices, 3), ``uvs`` (vertices, 2), all float32; ``triangles``
    has shape (triangles, 3), uint32; ``materials`` (triangles,), int32, picks one of the mesh's BSDFs and is
    clamped to their number by whoever renders.
    """

    positions: _Floats
    normals: _Floats
    uvs: _Floats
    triangles: npt.NDArray[np.uint32]
    materials: npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class CurveSet:
    """Quadratic B-spline curves in the space of their primitive.

    ``nodes`` has shape (nodes, 4), float32: control points and their width. ``ends`` has shape (curves,),
    int64: where in ``nodes`` every curve ends.
    """

    nodes: _Floats
    ends: _Ints


def mesh_geometry(mesh: Mesh) -> TriangleMesh:
    """Read a mesh as Tungsten renders it: with recomputed normals if the scene sets that."""
    read = read_mesh(mesh.file)
    return with_smooth_normals(read) if mesh.smooth and mesh.recompute_normals else read


def curve_geometry(curves: Curves) -> CurveSet:
    """Read curves as Tungsten renders them: with the thickness and the taper of the scene."""
    read = read_curves(curves.file)
    nodes, ends = read.nodes.copy(), read.ends
    if curves.curve_thickness is not None:
        nodes[:, 3] = curves.curve_thickness
    if curves.curve_taper:
        counts = np.diff(ends, prepend=0)
        place_in_curve = np.arange(len(nodes)) - np.repeat(ends - counts, counts)
        nodes[:, 3] *= 1.0 - (place_in_curve - 0.5) / np.maximum(np.repeat(counts, counts) - 1, 1)
    return CurveSet(nodes, ends)


def read_mesh(path: Path) -> TriangleMesh:
    """Read a .wo3 or .obj file.

    Raises InputError if it is neither, is cut off, or holds indices or positions that make no sense.
    """
    readers = {".wo3": _mesh_from_wo3, ".obj": _mesh_from_obj}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: expected a mesh in a .wo3 or .obj file, got {path.suffix!r}; convert it")
    mesh = readers[path.suffix.lower()](path, _bytes_of(path))
    if mesh.triangles.size and int(mesh.triangles.max()) >= len(mesh.positions):
        raise InputError(
            f"{path}: expected vertex indices below {len(mesh.positions)}, got {mesh.triangles.max()}; "
            "export the mesh again"
        )
    if not np.isfinite(mesh.positions).all():
        raise InputError(
            f"{path}: expected finite vertex positions, got NaN or infinity; export the mesh again"
        )
    for name, array in (("normals", mesh.normals), ("texture coordinates", mesh.uvs)):
        bad = ~np.isfinite(array)
        if bad.any():
            _LOG.warning("%s: %d %s are not finite and are replaced by 0", path, int(bad.sum()), name)
            array[bad] = 0.0
    return mesh


def read_curves(path: Path) -> CurveSet:
    """Read a .fiber or .hair file.

    Raises InputError if it is neither, is cut off, or holds invalid counts or positions.
    """
    readers = {".fiber": _curves_from_fiber, ".hair": _curves_from_hair}
    if path.suffix.lower() not in readers:
        raise InputError(
            f"{path}: expected curves in a .fiber or .hair file, got {path.suffix!r}; convert them"
        )
    curves = readers[path.suffix.lower()](path, _bytes_of(path))
    if (len(curves.ends) and int(curves.ends[-1]) != len(curves.nodes)) or not np.isfinite(
        curves.nodes
    ).all():
        raise InputError(
            f"{path}: expected finite nodes, as many as the curves need; export the curves again"
        )
    return curves


def with_smooth_normals(mesh: TriangleMesh) -> TriangleMesh:
    """Compute the vertex normals as Tungsten does: area-weighted, with edges kept where faces meet sharply.

    A corner whose face is sharply off the first face of its vertex gets a vertex of its own, with that face's
    normal.

    Raises InputError if so many vertices share one place that the work would not end.
    """
    positions = mesh.positions.astype(np.float64)
    corners = mesh.triangles.astype(np.int64).ravel()
    edges = positions[mesh.triangles[:, 1:]] - positions[mesh.triangles[:, :1]]
    weighted = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(weighted, axis=1, keepdims=True)
    unit = np.divide(weighted, length, out=np.zeros_like(weighted), where=length > 0.0)
    # A face without area has no direction; Tungsten takes it to face up.
    first_guess = np.where(length > 0.0, unit, [0.0, 1.0, 0.0])

    used, first_corner = np.unique(corners, return_index=True)
    reference = np.zeros_like(positions)
    reference[used] = first_guess[first_corner // 3]

    face = np.repeat(np.arange(len(mesh.triangles)), 3)
    is_split = np.einsum("ij,ij->i", reference[corners], first_guess[face]) < SPLIT_COSINE
    split_from = corners[is_split]
    new_corners = corners.copy()
    new_corners[is_split] = len(positions) + np.arange(len(split_from))

    normals = _summed_at_equal_places(positions, corners, face, weighted, unit, reference)
    normals = np.concatenate([normals, np.zeros((len(split_from), 3))])
    reference = np.concatenate([reference, first_guess[face[is_split]]])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0.0, normals / np.where(length > 0.0, length, 1.0), reference)
    return TriangleMesh(
        positions=np.concatenate([mesh.positions, mesh.positions[split_from]]),
        normals=normals.astype(np.float32),
        uvs=np.concatenate([mesh.uvs, mesh.uvs[split_from]]),
        triangles=new_corners.reshape(-1, 3).astype(np.uint32),
        materials=mesh.materials,
    )


def _summed_at_equal_places(
    positions: npt.NDArray[np.float64],
    corners: _Ints,
    face: _Ints,
    weighted: npt.NDArray[np.float64],
    unit: npt.NDArray[np.float64],
    reference: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """Sum, for every vertex, the faces around its place that are not sharply off its first face."""
    _, place = np.unique(positions, axis=0, return_inverse=True)
    place = place.reshape(-1)
    by_place = np.argsort(place, kind="stable")
    count = np.bincount(place)
    start = np.cumsum(count) - count

    # One pair for every corner and every vertex that shares its place.
    vertices_there = count[place[corners]]
    total = int(vertices_there.sum())
    if total > MAX_NORMAL_PAIRS:
        raise InputError(
            f"mesh: expected at most {MAX_NORMAL_PAIRS} pairs of coincident vertices, got {total}; "
            "merge them or set recompute_normals to false"
        )
    pairs_before = np.cumsum(vertices_there) - vertices_there
    sums = np.zeros((3, len(positions)))
    steps = np.arange(_NORMAL_PAIRS_AT_ONCE, total, _NORMAL_PAIRS_AT_ONCE)
    for part in np.split(np.arange(len(corners)), np.searchsorted(pairs_before, steps)):
        pair_corner = np.repeat(part, vertices_there[part])
        number = np.arange(len(pair_corner)) - (pairs_before[pair_corner] - pairs_before[part[:1]])
        pair_vertex = by_place[start[place[corners[pair_corner]]] + number]
        pair_face = face[pair_corner]
        smooth = np.einsum("ij,ij->i", reference[pair_vertex], unit[pair_face]) >= SPLIT_COSINE
        for axis in range(3):
            np.add.at(sums[axis], pair_vertex[smooth], weighted[pair_face[smooth], axis])
    return sums.T


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); check the path and the permissions") from None


class _Bytes:
    """A file in memory that is read from front to back, with checks of its end."""

    def __init__(self, path: Path, content: bytes, offset: int = 0) -> None:
        self.path = path
        self.content = content
        self.offset = offset

    def take(self, dtype: Any, count: int) -> npt.NDArray[Any]:
        size = np.dtype(dtype).itemsize
        left = len(self.content) - self.offset
        if not self.offset >= 0 or count > left // size:
            raise InputError(
                f"{self.path}: expected {count} entries of {size} bytes at byte {self.offset}, got "
                f"{max(left, 0)} bytes; the file is cut off or damaged, export it again"
            )
        array = np.frombuffer(self.content, dtype, count, self.offset)
        self.offset += count * size
        return array

    def take_int(self, dtype: str) -> int:
        return int(self.take(dtype, 1)[0])


def _mesh_from_wo3(path: Path, content: bytes) -> TriangleMesh:
    file = _Bytes(path, content)
    vertices = file.take(_WO3_VERTEX, file.take_int("<u8"))
    triangles = file.take(_WO3_TRIANGLE, file.take_int("<u8"))
    return TriangleMesh(
        positions=vertices["position"].copy(),
        normals=vertices["normal"].copy(),
        uvs=vertices["uv"].copy(),
        triangles=triangles["vertices"].copy(),
        materials=triangles["material"].copy(),
    )


def _mesh_from_obj(path: Path, content: bytes) -> TriangleMesh:
    """Read positions, normals, texture coordinates and faces as Tungsten does, without groups and materials.

    Polygons become fans, every different triple of indices one vertex; a missing normal is +y, a missing UV
    (0, 0).
    """
    tables: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    triples: dict[tuple[int, int, int], int] = {}
    index_of_token: dict[str, int] = {}
    triangles: list[tuple[int, int, int]] = []

    def damaged(number: int, line: str, expected: str) -> InputError:
        return InputError(
            f"{path}:{number}: expected {expected}, got {line.strip()[:60]!r}; export the mesh again"
        )

    def vertex_of(token: str) -> int:
        """Return the vertex that a corner such as 3/1/2, 3//2 or -1 names, or raise ValueError."""
        parts = [*token.split("/"), "", ""][:3]
        triple = []
        for part, table in zip(parts, tables.values(), strict=True):
            index = int(part or 0)
            index += len(table) + 1 if index < 0 else 0
            if not 0 <= index <= len(table):
                raise ValueError(token)
            triple.append(index)
        if triple[0] == 0:
            raise ValueError(token)
        found = triples.setdefault((triple[0], triple[1], triple[2]), len(triples))
        if "-" not in token:
            index_of_token[token] = found
        return found

    for number, line in enumerate(content.decode("latin-1").split("\n"), 1):
        kind, *words = line.split() or [""]
        kind = kind.lower()
        if kind in tables:
            size = 2 if kind == "vt" else 3
            try:
                values = [float(word) for word in words[:size]]
            except ValueError:
                raise damaged(number, line, f"{size} numbers") from None
            if len(values) < size and not (kind == "vt" and values):
                raise damaged(number, line, f"{size} numbers")
            tables[kind].append(values + [0.0] * (size - len(values)))
        elif kind == "f":
            words = words[: words.index("#")] if "#" in words else words
            try:
                fan = [index_of_token[word] if word in index_of_token else vertex_of(word) for word in words]
            except ValueError:
                raise damaged(number, line, "a face of vertices declared above it") from None
            triangles.extend((fan[0], fan[i], fan[i + 1]) for i in range(1, len(fan) - 1))

    indices = np.array(list(triples), np.int64).reshape(-1, 3)
    # Index 0 marks what the corner leaves out.
    defaults = {"v": [0.0, 0.0, 0.0], "vt": [0.0, 0.0], "vn": [0.0, 1.0, 0.0]}
    with np.errstate(over="ignore"):
        arrays = {kind: np.array([defaults[kind], *rows]).astype(np.float32) for kind, rows in tables.items()}
    return TriangleMesh(
        positions=arrays["v"][indices[:, 0]],
        normals=arrays["vn"][indices[:, 2]],
        uvs=arrays["vt"][indices[:, 1]],
        triangles=np.array(triangles, np.uint32).reshape(-1, 3),
        materials=np.zeros(len(triangles), np.int32),
    )


def _curves_from_fiber(path: Path, content: bytes) -> CurveSet:
    """Read Tungsten's .fiber: a header, then attributes; one with too few values repeats its last."""
    file = _Bytes(path, content)
    if file.take("u1", 8).tobytes() != _FIBER_MAGIC or file.take_int("<u2") != 1:
        raise InputError(f"{path}: expected a .fiber file of version 1; export the curves again")
    file.take_int("<u2")
    if file.take_int("<u4") != 0:
        raise InputError(f"{path}: expected fibers in the file, got another content; export the curves again")
    header_length, node_count, curve_count = (file.take_int("<u8") for _ in range(3))

    # By name, whether it is of every curve (or every node), the number of its type, values per element.
    dtypes = {
        ("num_vertices", True, 3, 1): np.dtype("<u2"),
        ("position", False, 8, 3): np.dtype(("<f4", 3)),
        ("width", False, 8, 1): np.dtype("<f4"),
    }
    attributes: dict[str, npt.NDArray[Any]] = {}
    offset = header_length
    while descriptor_length := (file := _Bytes(path, content, offset)).take_int("<u8"):
        data_length = file.take_int("<u8")
        per_curve = bool(file.take_int("<u2") & 1)
        value_type, values_per_element = file.take("u1", 2).tolist()
        name = content[file.offset : content.find(b"\0", file.offset)].decode("latin-1")
        offset += descriptor_length
        # An attribute of another kind is passed over, as in Tungsten, and so is one without values.
        dtype = dtypes.get((name, per_curve, value_type, values_per_element))
        if dtype is not None and data_length >= dtype.itemsize:
            attributes[name] = _Bytes(path, content, offset).take(dtype, data_length // dtype.itemsize)
        offset += data_length

    def values(name: str, count: int) -> npt.NDArray[Any]:
        # The file cannot hold more nodes than bytes, however many it claims.
        if name not in attributes or count > len(content):
            raise InputError(f"{path}: expected {count} values of {name}; export the curves again")
        given = attributes[name][:count]
        return np.concatenate([given, np.repeat(given[-1:], count - len(given), axis=0)])

    positions = values("position", node_count)
    widths = values("width", node_count) if "width" in attributes else np.zeros(node_count, np.float32)
    nodes = np.column_stack([positions, widths]).astype(np.float32)
    return CurveSet(nodes, np.cumsum(values("num_vertices", curve_count), dtype=np.int64))


def _curves_from_hair(path: Path, content: bytes) -> CurveSet:
    """Read Cem Yuksel's .hair (http://www.cemyuksel.com/research/hairmodels/)."""
    file = _Bytes(path, content)
    if file.take("u1", 4).tobytes() != b"HAIR":
        raise InputError(f"{path}: expected a .hair file, which starts with HAIR; export the curves again")
    curve_count, node_count, present = (file.take_int("<u4") for _ in range(3))
    default_segments = file.take_int("<u4")
    default_width = float(file.take("<f4", 1)[0])
    file.take("u1", 16 + 88)
    if not present & 2:
        raise InputError(f"{path}: expected points in the file, got none; export the curves again")
    segments = file.take("<u2", curve_count) if present & 1 else None
    # Taken before anything is allocated: the file must be long enough for as many nodes as it claims.
    points = file.take(("<f4", 3), node_count)
    widths = file.take("<f4", node_count) if present & 4 else np.full(node_count, default_width, np.float32)
    if segments is None:
        if curve_count > node_count:
            raise InputError(
                f"{path}: expected fewer curves than nodes, got {curve_count}; export the curves again"
            )
        segments = np.full(curve_count, default_segments)
    counts = segments.astype(np.int64) + 1
    return CurveSet(np.column_stack([points, widths]).astype(np.float32), np.cumsum(counts))
