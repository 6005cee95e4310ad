"""How Tungsten turns position, scale, rotation and axes into a matrix."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tungsten_dip.scene.types import Matrix, Vec3

_Axis = npt.NDArray[np.float64]


def matrix_from_transform(
    position: Vec3 = (0.0, 0.0, 0.0),
    *,
    look_at: Vec3 | None = None,
    up: Vec3 | None = None,
    x_axis: Vec3 | None = None,
    y_axis: Vec3 | None = None,
    z_axis: Vec3 | None = None,
    scale: Vec3 = (1.0, 1.0, 1.0),
    rotation: Vec3 = (0.0, 0.0, 0.0),
) -> Matrix:
    """Return Tungsten's 4x4 matrix of a ``transform`` object.

    The axes are made orthonormal and right-handed, starting from those that are given: ``look_at`` gives z,
    ``up`` gives y. They are scaled, then rotated by ``rotation`` (degrees about x, y, z), then moved to
    ``position``.

    Raises ValueError if a given axis has no length.
    """
    offset = np.asarray(position, dtype=np.float64)
    axes = {"x": np.array([1.0, 0.0, 0.0]), "y": np.array([0.0, 1.0, 0.0]), "z": np.array([0.0, 0.0, 1.0])}
    given: set[str] = set()
    # A later source of the same axis is used.
    sources = (("z", look_at), ("y", up), ("x", x_axis), ("y", y_axis), ("z", z_axis))
    for number, (name, direction) in enumerate(sources):
        if direction is not None:
            axes[name] = np.asarray(direction, dtype=np.float64) - (offset if number == 0 else 0.0)
            given.add(name)
    for name in given:
        if not np.linalg.norm(axes[name]) > 0.0:
            raise ValueError(f"the {name} axis has no length")

    # The first of the order keeps its direction, the last takes what is left.
    orders = {"": "zyx", "x": "xzy", "y": "yzx", "xy": "yxz", "xz": "zxy"}
    first, second, third = tuple(orders.get("".join(sorted(given)), "zyx"))
    axes[first] = axes[first] / np.linalg.norm(axes[first])
    axes[second] = _orthogonalised(axes[second], [axes[first]], _any_orthogonal(axes[first]))
    rest = np.cross(axes[first], axes[second])
    axes[third] = _orthogonalised(axes[third], [axes[first], axes[second]], rest)
    if np.dot(np.cross(axes["x"], axes["y"]), axes["z"]) < 0.0:
        flipped = next((name for name in "xy" if name not in given), "z")
        axes[flipped] = -axes[flipped]

    matrix = np.eye(4)
    columns = np.stack([axes["x"], axes["y"], axes["z"]], axis=1) * np.asarray(scale, dtype=np.float64)
    matrix[:3, :3] = rotation_matrix(rotation) @ columns
    matrix[:3, 3] = offset
    return matrix


def rotation_matrix(degrees: Vec3) -> npt.NDArray[np.float64]:
    """Return the 3x3 rotation R_y(-y) R_x(x) R_z(z): about z first, and about y clockwise."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, -sy], [0.0, 1.0, 0.0], [sy, 0.0, cy]])
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_y @ about_x @ about_z)


def _orthogonalised(axis: _Axis, others: list[_Axis], fallback: _Axis) -> _Axis:
    for other in others:
        axis = axis - other * np.dot(axis, other)
    squared_length = float(np.dot(axis, axis))
    # 1e-5 is where Tungsten takes two axes for parallel.
    return fallback if squared_length < 1e-5 else axis / np.sqrt(squared_length)


def _any_orthogonal(axis: _Axis) -> _Axis:
    helper = np.array([0.0, 1.0, 0.0]) if abs(axis[0]) > abs(axis[1]) else np.array([1.0, 0.0, 0.0])
    orthogonal = np.cross(axis, helper)
    return np.asarray(orthogonal / np.linalg.norm(orthogonal))
