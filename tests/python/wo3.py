"""Meshes in Tungsten's binary format, written value by value as its `MeshIO` does."""

from __future__ import annotations

import struct
from pathlib import Path

from tungsten_dip.scene.meshes import TriangleMesh


def write_wo3(path: Path, mesh: TriangleMesh) -> None:
    """Write a mesh."""
    vertices = [
        struct.pack("<8f", *position, *normal, *uv)
        for position, normal, uv in zip(mesh.positions, mesh.normals, mesh.uvs, strict=True)
    ]
    triangles = [
        struct.pack("<3Ii", *corners, material)
        for corners, material in zip(mesh.triangles, mesh.materials, strict=True)
    ]
    parts = [part for list_ in (vertices, triangles) for part in (struct.pack("<Q", len(list_)), *list_)]
    path.write_bytes(b"".join(parts))
