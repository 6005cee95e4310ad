"""A small synthetic render with known truth and noise, and what replaces fits and renders of commands."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commands import write_scene
from fitted_models import DRAFT
from tungsten_dip.buffers.relmse import relative_squared_error
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.fit import FitResult, FitSettings, denoise
from tungsten_dip.fit.model import Model
from tungsten_dip.fit.result import HistoryPoint
from tungsten_dip.onnx import save_model
from tungsten_dip.progress import silent

SAMPLE_SHAPE = 0.5
"""Samples are gamma distributed with this shape around the true radiance: variance radiance^2 / shape."""


OPTIONAL = (
    "torch",
    "mitsuba",
    "pyoidn",
    "distributed",
    "matplotlib",
    "flip_evaluator",
    "skimage",
    "playwright",
)
"""What some tests need, and are skipped without; where CI runs them, nothing may be missing."""


def pytest_configure() -> None:
    """Refuse to skip on a machine that is there to test everything."""
    missing = [name for name in OPTIONAL if find_spec(name) is None]
    if missing and os.environ.get("CI"):
        raise pytest.UsageError(f"CI is set, and {', '.join(missing)} is not installed")


@dataclass(frozen=True)
class SyntheticRender:
    """Buffers as a renderer would write them, and the noise-free colour behind them."""

    buffers: RenderBuffers
    reference: FloatImage


MakeRender = Callable[..., SyntheticRender]


@pytest.fixture
def make_render() -> MakeRender:
    """``make_render(height=40, width=56, spp=16, seed=0)``: a sphere on a checkered floor before a sky."""
    return synthetic_render


@pytest.fixture
def render() -> SyntheticRender:
    """The synthetic render at its default size."""
    return synthetic_render()


@pytest.fixture(scope="session")
def frame() -> SyntheticRender:
    """The image that `model` is fitted to."""
    return synthetic_render(32, 48)


@pytest.fixture(scope="session")
def next_frame() -> SyntheticRender:
    """The same with other noise."""
    return synthetic_render(32, 48, seed=1)


@pytest.fixture(scope="session")
def fitted(frame: SyntheticRender) -> FitResult:
    """What a short fit of preset draft makes of `frame`."""
    return denoise(frame.buffers, DRAFT)


@pytest.fixture(scope="session")
def model(fitted: FitResult) -> Model:
    """The network of that fit."""
    assert fitted.model is not None
    return fitted.model


@pytest.fixture
def saved(model: Model, tmp_path: Path) -> Path:
    """The file of that network."""
    save_model(tmp_path / "m.onnx", model)
    return tmp_path / "m.onnx"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A small scene's file."""
    return write_scene(tmp_path / "scene.json")


@pytest.fixture
def folder(tmp_path: Path, render: SyntheticRender) -> Path:
    """The synthetic render as Tungsten's buffer files."""
    write_tungsten_folder(tmp_path / "buffers", render.buffers)
    return tmp_path / "buffers"


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[FitSettings]:
    """Replaces the fit by its mean colour; lists the settings that it was called with."""
    calls = []

    def mean_color(buffers, settings=None, progress=silent, warm_start=None):
        settings = settings or FitSettings()
        calls.append(settings)
        os.write(1, b"a library that chatters on stdout\n")
        progress(0.5, "halfway")
        color = np.broadcast_to(buffers.color.mean.mean((0, 1)), buffers.color.mean.shape).copy()
        error = np.full((buffers.height, buffers.width, 1), 0.25, np.float32)
        known = buffers.color.halves is not None
        return FitResult(
            color=color,
            settings=settings,
            seconds=1.5,
            iterations=7,
            error=error if known else None,
            estimated_relmse=0.25 if known else None,
            history=(HistoryPoint(0.5, 3, 0.5), HistoryPoint(1.5, 7, 0.25)),
        )

    monkeypatch.setattr("tungsten_dip.cli.denoising.denoise", mean_color)
    return calls


@pytest.fixture
def renders(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Replaces Mitsuba by the synthetic render; lists what it was asked for."""
    calls = []

    def render(scene, *, spp, seed, threads, timeout_s, progress, quantities):
        calls.append({"spp": spp, "seed": seed, "timeout_s": timeout_s, "quantities": quantities})
        width, height = scene.camera.resolution
        buffers = synthetic_render(height, width, seed=seed).buffers
        unwanted = {"albedo", "normal", "depth"}.difference(quantities)
        return buffers.with_quantities(**dict.fromkeys(unwanted))

    monkeypatch.setattr("tungsten_dip.cli.tungsten.render_with_mitsuba", render)
    monkeypatch.setattr("tungsten_dip.hosts.tungsten.available", lambda: False)
    return calls


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
