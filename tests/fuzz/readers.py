"""The readers of files that nobody has to trust, and whole files to start from."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synthetic import synthetic_render
from tungsten_dip.buffers.read import read_buffers
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.fit.write import write_denoised
from tungsten_dip.onnx import load_model, save_model
from tungsten_dip.scene.effects import inspect_facts
from tungsten_dip.scene.meshes import TriangleMesh, read_curves, read_mesh, with_smooth_normals
from tungsten_dip.scene.parse import load_scene
from wo3 import write_wo3

_EXAMPLES = Path(__file__).parents[2] / "examples"


@dataclass(frozen=True)
class Reader:
    """What reads files of a suffix, and examples of these. It may raise InputError and nothing else."""

    suffix: str
    read: Callable[[Path], object]
    examples: Callable[[], list[bytes]]


def _scenes() -> list[bytes]:
    return [path.read_bytes() for path in sorted(_EXAMPLES.glob("*/scene.json"))]


def _written(suffix: str, write: Callable[[Path], object]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write(path)
        return path.read_bytes()


def _triangle() -> TriangleMesh:
    corners = np.eye(3, dtype=np.float32)
    return TriangleMesh(
        corners, corners, corners[:, :2], np.array([[0, 1, 2]], np.uint32), np.zeros(1, np.int32)
    )


def _images() -> list[bytes]:
    buffers = synthetic_render(5, 6, 4).buffers
    result = denoise(buffers, FitSettings(preset="draft", iterations=1, threads=1))
    return [_written(".exr", lambda path: write_denoised(path, result, buffers))]


def _models() -> list[bytes]:
    buffers = synthetic_render(16, 16, 4).buffers
    draft = FitSettings(preset="draft", iterations=1, threads=1)
    paper = FitSettings(preset="paper", iterations=1, threads=1, channels=(2, 2))
    models = [denoise(buffers, settings).model for settings in (draft, paper)]
    return [_written(".onnx", lambda path, m=model: save_model(path, m)) for model in models if model]


_OBJ = b"# a\nv 0 0 0\nv 1 0 0 1\nv 0 1 0\nvt 0 0\nvt 1 0\nvn 0 0 1\nf 1/1/1 2/2/1 3//1\nf -3 -2 -1\n"
_HAIR = (
    b"HAIR"
    + np.array([1, 2, 3, 1], "<u4").tobytes()
    + np.float32(0.1).tobytes()
    + bytes(104)
    + np.array([1], "<u2").tobytes()
    + np.arange(6, dtype="<f4").tobytes()
)

READERS = {
    "scene": Reader(".json", lambda path: inspect_facts(load_scene(path)), _scenes),
    "wo3": Reader(
        ".wo3",
        lambda path: with_smooth_normals(read_mesh(path)),
        lambda: [_written(".wo3", lambda path: write_wo3(path, _triangle()))],
    ),
    "obj": Reader(".obj", lambda path: with_smooth_normals(read_mesh(path)), lambda: [_OBJ]),
    "hair": Reader(".hair", read_curves, lambda: [_HAIR]),
    "fiber": Reader(".fiber", read_curves, lambda: [b"\x80\xbf\x80FIBER\x01\0" + bytes(64)]),
    "exr": Reader(".exr", read_buffers, _images),
    "buffers of a scene": Reader(
        ".json",
        read_buffers,
        lambda: [
            json.dumps(
                {"renderer": {"output_buffers": [{"type": "color", "hdr_output_file": "c.exr"}]}}
            ).encode()
        ],
    ),
    "onnx": Reader(".onnx", load_model, _models),
}
