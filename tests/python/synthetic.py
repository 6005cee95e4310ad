"""A small synthetic render with known truth and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tungsten_dip.buffers.relmse import relative_squared_error
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers

SAMPLE_SHAPE = 0.5
"""Samples are gamma distributed with this shape around the true radiance: variance radiance^2 / shape."""


@dataclass(frozen=True)
class SyntheticRender:
    """Buffers as a renderer would write them, and the noise-free colour behind them."""

    buffers: RenderBuffers
    reference: FloatImage


def relmse(image: FloatImage, reference: FloatImage) -> float:
    """Return mean((x - r)^2 / (r^2 + 0.01)), as `report.metrics.compare` does."""
    return float(relative_squared_error(image, reference).mean())


def synthetic_render(height: int = 40, width: int = 56, spp: int = 16, seed: int = 0) -> SyntheticRender:
    """Return a sphere on a checkered floor before a sky, rendered with independent samples."""
    rng = np.random.default_rng(seed)
    truth = _ground_truth(height, width)
    cosine = truth["normal"] @ np.array([0.4, 0.8, 0.45])
    color = truth["albedo"] * (0.1 + np.clip(cosine, 0, None)[..., None])
    color[truth["depth"][..., 0] == 0] = (0.3, 0.5, 1.5)
    buffers = {"color": _noisy(rng, color, spp)}
    for name, scale in (("albedo", 0.02), ("normal", 0.02), ("depth", 0.01)):
        half_a, half_b = (truth[name] + scale * rng.standard_normal(truth[name].shape) for _ in range(2))
        variance = np.full(truth[name].shape, scale**2 / 2)
        buffers[name] = _buffer((half_a + half_b) / 2, half_a, half_b, variance)
    return SyntheticRender(RenderBuffers(**buffers, spp=float(spp)), color.astype(np.float32))


def rgb_from_plane(plane: np.ndarray) -> FloatImage:
    """Return a plane of shape (height, width) as a grey image of three channels."""
    return np.repeat(plane[:, :, None], 3, axis=2).astype(np.float32)


def buffer_of_halves(half_a: FloatImage, half_b: FloatImage) -> Buffer:
    """Return a buffer of two halves and their mean."""
    return Buffer((half_a + half_b) / 2, half_a, half_b)


def _ground_truth(height: int, width: int) -> dict[str, np.ndarray]:
    v, u = np.meshgrid(np.linspace(1, -1, height), np.linspace(-1.4, 1.4, width), indexing="ij")
    normal = np.zeros((height, width, 3))
    normal[..., 2] = 1
    albedo = np.ones((height, width, 3))
    depth = np.zeros((height, width, 1))

    floor = v < -0.2
    normal[floor] = (0, 1, 0)
    distance = 1 / np.clip(-v, 0.2, None)
    checker = (np.floor(u * distance * 2) + np.floor(distance * 2)) % 2 == 0
    albedo[floor] = np.where(checker[..., None], (0.8, 0.75, 0.7), (0.2, 0.25, 0.3))[floor]
    depth[floor] = distance[floor][:, None]

    sphere = (u - 0.1) ** 2 + v**2 < 0.45
    bulge = np.sqrt(np.clip(0.45 - (u - 0.1) ** 2 - v**2, 0, None))
    normal[sphere] = (np.stack([u - 0.1, v, bulge], axis=-1) / np.sqrt(0.45))[sphere]
    albedo[sphere] = (0.9, 0.3, 0.2)
    depth[sphere] = (1.5 - bulge)[sphere][:, None]
    return {"normal": normal, "albedo": albedo, "depth": depth}


def _noisy(rng: np.random.Generator, radiance: np.ndarray, spp: int) -> Buffer:
    half_shape = SAMPLE_SHAPE * spp / 2
    half_a, half_b = (radiance * rng.gamma(half_shape, 1 / half_shape, radiance.shape) for _ in range(2))
    degrees = max(spp - 1, 1)
    variance = radiance**2 / (SAMPLE_SHAPE * spp) * rng.chisquare(degrees, radiance.shape) / degrees
    return _buffer((half_a + half_b) / 2, half_a, half_b, variance)


def _buffer(*planes: np.ndarray) -> Buffer:
    return Buffer(*(np.ascontiguousarray(plane, dtype=np.float32) for plane in planes))
