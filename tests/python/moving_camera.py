"""Frames whose truth is known: a floor and a wall with texture and soft light, before a moving camera."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.scene.parse import load_scene
from tungsten_dip.scene.types import Camera

WIDTH, HEIGHT = 48, 32
FOV = 50.0
SAMPLE_SHAPE = 0.5


@dataclass(frozen=True)
class TrueFrame:
    """Noisy buffers, and what they are of."""

    buffers: RenderBuffers
    reference: FloatImage
    camera: Camera


def write_scene(path: Path, shift: float) -> Path:
    """Write a Tungsten scene whose camera stands ``shift`` to the right."""
    transform = {"position": [shift, 1.0, 4.0], "look_at": [0.4 * shift, 0.8, 0.0], "up": [0, 1, 0]}
    camera = {"type": "pinhole", "fov": FOV, "resolution": [WIDTH, HEIGHT], "transform": transform}
    path.write_text(json.dumps({"camera": camera}))
    return path


def true_frame(
    folder: Path,
    shift: float,
    seed: int,
    spp: int = 16,
    light: float = 1.0,
    shade: npt.NDArray[np.float64] | None = None,
) -> TrueFrame:
    """Return the frame of a camera that stands ``shift`` to the right.

    Its radiance is multiplied by ``shade``, shape (height, width, 1), which no feature contains.
    """
    camera = load_scene(write_scene(folder / "camera.json", shift)).camera
    rng = np.random.default_rng(seed)
    albedo, normal, depth, color = _seen(camera, light)
    if shade is not None:
        color = color * shade
    shape = SAMPLE_SHAPE * spp / 2
    half_a, half_b = (color * rng.gamma(shape, 1 / shape, color.shape) for _ in range(2))
    variance = color**2 / (SAMPLE_SHAPE * spp)
    buffers = RenderBuffers(
        color=_buffer((half_a + half_b) / 2, half_a, half_b, variance),
        albedo=_buffer(albedo, albedo, albedo, 0 * albedo),
        normal=_buffer(normal, normal, normal, 0 * normal),
        depth=_buffer(depth, depth, depth, 0 * depth),
        spp=float(spp),
    )
    return TrueFrame(buffers, color.astype(np.float32), camera)


def write_frames(folder: Path, count: int, spp: int = 16) -> None:
    """Write ``noisy/f0000``... and ``cameras/f0000.json``... of a camera that moves to the right."""
    (folder / "cameras").mkdir(parents=True)
    for number in range(count):
        shift = 0.05 * number
        write_scene(folder / "cameras" / f"f{number:04d}.json", shift)
        frame = true_frame(folder, shift, seed=number, spp=spp)
        write_tungsten_folder(folder / "noisy" / f"f{number:04d}", frame.buffers)


def _seen(camera: Camera, light: float) -> tuple[np.ndarray, ...]:
    frame = np.asarray(camera.world_from_local)
    x = (np.arange(WIDTH) + 0.5) * 2 / WIDTH - 1
    y = (HEIGHT - 2 * (np.arange(HEIGHT) + 0.5)) / WIDTH
    ray = np.stack(
        np.broadcast_arrays(x[None, :], y[:, None], 1 / np.tan(np.radians(FOV) / 2)), axis=-1
    ).astype(float)
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    ray = ray @ frame[:3, :3].T
    origin = frame[:3, 3]
    with np.errstate(divide="ignore"):
        to_floor = np.where(ray[..., 1] < 0, -origin[1] / ray[..., 1], np.inf)
        to_wall = np.where(ray[..., 2] < 0, (-1 - origin[2]) / ray[..., 2], np.inf)
    floor = to_floor < to_wall
    distance = np.minimum(np.minimum(to_floor, to_wall), 1e3)
    point = origin + distance[..., None] * ray
    sky = ~floor & (point[..., 1] > 1.6)
    normal = np.where(floor[..., None], (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    bright = np.where(floor, np.floor(point[..., 0]) % 2, np.floor(2 * point[..., 1]) % 2) == 0
    albedo = np.where(bright[..., None], (0.8, 0.7, 0.6), (0.3, 0.4, 0.5))
    irradiance = light * (0.6 + 0.4 * np.sin(1.5 * point[..., :1]) * np.cos(point[..., 2:]))
    color = albedo * irradiance
    for image, value in ((normal, -ray), (albedo, np.ones(3)), (color, np.full(3, 0.2 * light))):
        image[sky] = np.broadcast_to(value, image.shape)[sky]
    depth = np.where(sky, 0, distance)[..., None]
    return albedo, normal, depth, color


def _buffer(*planes: np.ndarray) -> Buffer:
    return Buffer(*(np.ascontiguousarray(plane, dtype=np.float32) for plane in planes))
