"""Meshes and curves: round trips, what Tungsten does with normals, and files that lie."""

import struct
import tracemalloc

import numpy as np
import pytest

from tungsten_dip.errors import InputError
from tungsten_dip.scene import meshes
from tungsten_dip.scene.meshes import (
    CurveSet,
    TriangleMesh,
    curve_geometry,
    mesh_geometry,
    read_curves,
    read_mesh,
    with_smooth_normals,
)
from tungsten_dip.scene.types import Curves, Mesh
from wo3 import write_wo3

CUBE_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
CUBE_TRIANGLES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ],
    np.uint32,
)


def mesh_of(positions, triangles, normals=None, uvs=None):
    positions = np.asarray(positions, np.float32)
    return TriangleMesh(
        positions=positions,
        normals=np.zeros_like(positions) if normals is None else normals,
        uvs=np.zeros((len(positions), 2), np.float32) if uvs is None else uvs,
        triangles=np.asarray(triangles, np.uint32).reshape(-1, 3),
        materials=np.arange(len(triangles), dtype=np.int32) - 1,
    )


def assert_equal_meshes(a, b):
    for name in ("positions", "normals", "uvs", "triangles", "materials"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_wo3_round_trip_is_bit_exact(tmp_path):
    random = np.random.default_rng(3)
    mesh = mesh_of(
        random.normal(size=(7, 3)),
        random.integers(0, 7, (5, 3)),
        random.normal(size=(7, 3)).astype(np.float32),
        random.random((7, 2), np.float32),
    )
    write_wo3(tmp_path / "m.wo3", mesh)
    assert (tmp_path / "m.wo3").stat().st_size == 16 + 7 * 32 + 5 * 16
    assert_equal_meshes(read_mesh(tmp_path / "m.wo3"), mesh)


def test_wo3_without_triangles(tmp_path):
    write_wo3(tmp_path / "m.wo3", mesh_of(np.zeros((0, 3)), []))
    assert read_mesh(tmp_path / "m.wo3").triangles.shape == (0, 3)


def test_obj_corners_become_vertices_and_polygons_fans(tmp_path):
    path = tmp_path / "m.OBJ"
    path.write_text(
        "# a comment\nmtllib none.mtl\no thing\nusemtl paint\ns off\n"
        "v 0 0 0 1 1 1\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
        "vt 0 0\nvt 1 0\nvn 0 0 1\n"
        "f 1/1/1 2/2/1 3/2/1 4/1/1 # a square\nf -4//-1 -3//-1 -2//-1\nf 1 2 3\n"
    )
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2], [0, 2, 3], [4, 5, 6], [7, 8, 9]])
    np.testing.assert_array_equal(mesh.positions[:4], [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.positions[4:7], mesh.positions[7:])
    np.testing.assert_array_equal(mesh.uvs[:4], [[0, 0], [1, 0], [1, 0], [0, 0]])
    np.testing.assert_array_equal(mesh.normals[:7], [[0, 0, 1]] * 7)
    # What a corner leaves out: +y, as Tungsten has it.
    np.testing.assert_array_equal(mesh.normals[7:], [[0, 1, 0]] * 3)
    assert mesh.materials.tolist() == [0, 0, 0, 0]


def test_obj_agrees_with_wo3_of_the_same_mesh(tmp_path):
    lines = [f"v {x:g} {y:g} {z:g}" for x, y, z in CUBE_CORNERS]
    lines += ["f " + " ".join(str(i + 1) for i in triangle) for triangle in CUBE_TRIANGLES]
    (tmp_path / "m.obj").write_text("\n".join(lines))
    from_obj = read_mesh(tmp_path / "m.obj")
    np.testing.assert_array_equal(from_obj.positions[from_obj.triangles], CUBE_CORNERS[CUBE_TRIANGLES])


def test_smooth_normals_of_a_sphere_point_outwards():
    theta, phi = np.meshgrid(
        np.linspace(0.2, np.pi - 0.2, 24), np.linspace(0, 2 * np.pi, 49)[:-1], indexing="ij"
    )
    points = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1).reshape(
        -1, 3
    )
    i, j = np.meshgrid(np.arange(23), np.arange(48), indexing="ij")
    a, b = i * 48 + j, i * 48 + (j + 1) % 48
    triangles = np.concatenate(
        [np.stack([a, b, a + 48], -1).reshape(-1, 3), np.stack([b, b + 48, a + 48], -1).reshape(-1, 3)]
    )
    smooth = with_smooth_normals(mesh_of(points, triangles))
    assert len(smooth.positions) == len(points)
    cosine = np.abs(np.sum(smooth.normals * points, axis=1))
    assert cosine.min() > 0.99
    np.testing.assert_allclose(np.linalg.norm(smooth.normals, axis=1), 1.0, rtol=1e-6)


def test_smooth_normals_keep_the_edges_of_a_cube():
    smooth = with_smooth_normals(mesh_of(CUBE_CORNERS, CUBE_TRIANGLES))
    corners = smooth.positions[smooth.triangles].astype(np.float64)
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for corner in range(3):
        np.testing.assert_allclose(smooth.normals[smooth.triangles[:, corner]], faces, atol=1e-6)
    np.testing.assert_array_equal(smooth.positions[smooth.triangles], CUBE_CORNERS[CUBE_TRIANGLES])


def test_smooth_normals_cross_a_seam_of_equal_positions():
    """Two faces at 20 degrees, each with vertices of its own on the shared edge: they share normals."""
    tilt = np.radians(20)
    points = [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 0, 0], [0, 0, 1], [-np.cos(tilt), np.sin(tilt), 0]]
    smooth = with_smooth_normals(mesh_of(points, [[0, 1, 2], [3, 5, 4]]))
    np.testing.assert_allclose(smooth.normals[0], smooth.normals[3], atol=1e-6)
    np.testing.assert_allclose(smooth.normals[0], [np.sin(tilt / 2), np.cos(tilt / 2), 0], atol=1e-6)


def test_smooth_normals_of_many_vertices_at_one_place(monkeypatch):
    """Tents that meet at their tips, each with a tip of its own: all tips have one normal."""
    count = 9
    angle = np.linspace(0, 2 * np.pi, count + 1)
    ring = np.stack([np.cos(angle), np.full(count + 1, -0.2), np.sin(angle)], axis=1)
    points = np.concatenate([[[0, 0, 0], ring[i + 1], ring[i]] for i in range(count)])
    mesh = mesh_of(points, np.arange(3 * count))
    at_once = with_smooth_normals(mesh)
    np.testing.assert_allclose(at_once.normals[::3], [[0, 1, 0]] * count, atol=1e-6)
    for pairs in (1, 5, count * count):
        monkeypatch.setattr(meshes, "_NORMAL_PAIRS_AT_ONCE", pairs)
        np.testing.assert_allclose(with_smooth_normals(mesh).normals, at_once.normals, atol=1e-6)


def test_smooth_normals_take_little_memory_however_many_vertices_share_a_place():
    count = 3000
    mesh = mesh_of(np.zeros((count, 3)), np.arange(count))
    tracemalloc.start()
    try:
        assert len(with_smooth_normals(mesh).normals) == count
        assert tracemalloc.get_traced_memory()[1] < 200 << 20
    finally:
        tracemalloc.stop()


def test_smooth_normals_of_too_many_vertices_at_one_place_are_refused():
    count = 3 * 4096
    with pytest.raises(InputError, match="merge them or set recompute_normals to false"):
        with_smooth_normals(mesh_of(np.zeros((count, 3)), np.arange(count)))


def test_smooth_normals_of_nothing():
    assert with_smooth_normals(mesh_of(np.zeros((0, 3)), [])).normals.shape == (0, 3)


def test_smooth_normals_of_a_face_without_area_are_finite():
    smooth = with_smooth_normals(mesh_of([[0, 0, 0], [1, 1, 1], [2, 2, 2]], [[0, 1, 2]]))
    np.testing.assert_array_equal(smooth.normals, [[0, 1, 0]] * 3)


def test_normals_are_computed_anew_only_when_smooth_asks_for_it(tmp_path):
    path = tmp_path / "m.wo3"
    write_wo3(path, mesh_of(CUBE_CORNERS, CUBE_TRIANGLES))
    assert not mesh_geometry(Mesh(file=path, recompute_normals=True)).normals.any()
    assert not mesh_geometry(Mesh(file=path, smooth=True)).normals.any()
    assert mesh_geometry(Mesh(file=path, smooth=True, recompute_normals=True)).normals.any()


def wo3(vertices, triangles, body):
    return struct.pack("<Q", vertices) + body + struct.pack("<Q", triangles)


TRIANGLE = b"\0" * 96


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("m.wo3", b""),
        ("m.wo3", b"\1\0\0"),
        ("m.wo3", wo3(2**63, 0, TRIANGLE)),
        ("m.wo3", wo3(3, 2**60, TRIANGLE)),
        ("m.wo3", wo3(3, 1, TRIANGLE) + b"\0" * 15),
        ("m.wo3", wo3(3, 1, TRIANGLE) + struct.pack("<IIIi", 0, 1, 3, 0)),
        ("m.wo3", wo3(1, 0, struct.pack("<8f", np.nan, *[0] * 7))),
        ("m.obj", b"v 1 2\n"),
        ("m.obj", b"v 1 2 x\n"),
        ("m.obj", b"v 1 2 1e400\nf 1 1 1\n"),
        ("m.obj", b"v 0 0 0\nf 1 2 3\n"),
        ("m.obj", b"v 0 0 0\nf 1 -2 1\n"),
        ("m.obj", b"v 0 0 0\nf 1/5/1 1 1\n"),
        ("m.obj", b"v 0 0 0\nf 0 0 0\n"),
        ("m.obj", b"v 0 0 0\nf 1 99999999999999999999 1\n"),
        ("m.ply", b"ply\n"),
        ("missing.obj", None),
    ],
)
def test_damaged_meshes_are_refused_in_one_line(tmp_path, name, content):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_mesh(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_normals_that_are_not_finite_are_mended_and_said(tmp_path, caplog):
    normals = np.full((3, 3), np.nan, np.float32)
    write_wo3(tmp_path / "m.wo3", mesh_of(np.zeros((3, 3)), [[0, 1, 2]], normals))
    assert not read_mesh(tmp_path / "m.wo3").normals.any()
    assert "9 normals are not finite" in caplog.text


# --- Curves ---


def fiber_attribute(name, data, flags, kind, per_element):
    name = name.encode() + b"\0"
    return struct.pack("<QQHBB", 20 + len(name), len(data), flags, kind, per_element) + name + data


def fiber(nodes, counts, *, with_width=True, more=b""):
    """Write curves as Tungsten's .fiber does, and ``more`` attributes behind them."""
    attribute = fiber_attribute
    content = b"\x80\xbf\x80FIBER" + struct.pack("<HHIQQQ", 1, 0, 0, 40, len(nodes), len(counts))
    content += attribute("num_vertices", np.asarray(counts, "<u2").tobytes(), 1, 3, 1)
    content += attribute("unknown", b"12345", 0, 0, 1)
    content += attribute("position", np.asarray(nodes, "<f4")[:, :3].tobytes(), 0, 8, 3)
    if with_width:
        content += attribute("width", np.asarray(nodes, "<f4")[:, 3].tobytes(), 0, 8, 1)
    return content + more + struct.pack("<Q", 0)


NODES = np.random.default_rng(5).random((7, 4), np.float32)


def test_fiber(tmp_path):
    path = tmp_path / "c.fiber"
    path.write_bytes(fiber(NODES, [3, 4]))
    curves = read_curves(path)
    np.testing.assert_array_equal(curves.nodes, NODES)
    assert curves.ends.tolist() == [3, 7]


def test_fiber_repeats_the_last_value_of_a_short_attribute(tmp_path):
    path = tmp_path / "c.fiber"
    content = fiber(np.tile(NODES[:3], (2, 1)), [3])
    # Two curves are declared but only one count is given.
    path.write_bytes(content[:32] + struct.pack("<Q", 2) + content[40:])
    assert read_curves(path).ends.tolist() == [3, 6]


OTHERS = np.full((7, 3), 9, "<f4").tobytes()


@pytest.mark.parametrize(
    "attribute",
    [
        ("position", OTHERS, 1, 8, 3),  # of every curve
        ("position", OTHERS, 0, 4, 3),  # whole numbers
        ("position", OTHERS, 0, 8, 4),
        ("width", OTHERS, 0, 9, 1),  # doubles
        ("width", b"", 0, 8, 1),
        ("num_vertices", OTHERS, 0, 3, 1),
    ],
)
def test_fiber_attributes_of_another_kind_are_passed_over(tmp_path, attribute):
    path = tmp_path / "c.fiber"
    path.write_bytes(fiber(NODES, [3, 4], more=fiber_attribute(*attribute)))
    curves = read_curves(path)
    np.testing.assert_array_equal(curves.nodes, NODES)
    assert curves.ends.tolist() == [3, 7]


@pytest.mark.parametrize("present", [0b111, 0b011, 0b110])
def test_hair(tmp_path, present):
    path = tmp_path / "c.hair"
    nodes = NODES[:6]
    content = b"HAIR" + struct.pack("<IIIIfffff", 2, 6, present, 2, 0.25, 0.0, 1.0, 1.0, 1.0) + b" " * 88
    content += np.array([1, 3], "<u2").tobytes() if present & 1 else b""
    content += nodes[:, :3].tobytes()
    content += nodes[:, 3].tobytes() if present & 4 else b""
    path.write_bytes(content)
    curves = read_curves(path)
    assert curves.ends.tolist() == ([2, 6] if present & 1 else [3, 6])
    np.testing.assert_array_equal(curves.nodes[:, :3], nodes[:, :3])
    np.testing.assert_array_equal(curves.nodes[:, 3], nodes[:, 3] if present & 4 else np.full(6, 0.25))


def test_thickness_and_taper_of_the_scene(tmp_path):
    path = tmp_path / "c.fiber"
    path.write_bytes(fiber(NODES, [3, 4]))
    thick = curve_geometry(Curves(file=path, curve_thickness=0.5))
    assert thick.nodes[:, 3].tolist() == [0.5] * 7
    tapered = curve_geometry(Curves(file=path, curve_thickness=0.5, curve_taper=True))
    np.testing.assert_allclose(tapered.nodes[:3, 3], [0.5 * 1.25, 0.5 * 0.75, 0.5 * 0.25], rtol=1e-6)
    np.testing.assert_array_equal(curve_geometry(Curves(file=path)).nodes, NODES)
    assert isinstance(tapered, CurveSet)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("c.fiber", b""),
        ("c.fiber", b"\x80\xbf\x80FIBER" + struct.pack("<HHIQQQ", 2, 0, 0, 40, 0, 0)),
        ("c.fiber", b"\x80\xbf\x80FIBER" + struct.pack("<HHIQQQ", 1, 0, 0, 2**63, 1, 1)),
        ("c.fiber", fiber(NODES, [3, 3])),
        ("c.fiber", fiber(NODES, [3, 4])[:-30]),
        ("c.fiber", fiber(NODES, [3, 4])[:24] + struct.pack("<Q", 2**62) + fiber(NODES, [3, 4])[32:]),
        ("c.fiber", fiber(np.full((3, 4), np.inf), [3])),
        ("c.hair", b"HAIR" + b"\xff" * 124),
        ("c.hair", b"HAIL" + b"\0" * 124),
        ("c.txt", b""),
    ],
)
def test_damaged_curves_are_refused_in_one_line(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_curves(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_hair_that_claims_billions_of_curves_is_refused_before_anything_is_allocated(tmp_path):
    header = b"HAIR" + struct.pack("<IIIIf", 2**32 - 2, 2**32 - 1, 2, 5, 0.1)
    (tmp_path / "a.hair").write_bytes(header + bytes(16 + 88 + 24))
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="cut off or damaged"):
            read_curves(tmp_path / "a.hair")
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
