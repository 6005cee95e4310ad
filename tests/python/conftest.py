"""Fixtures: synthetic renders and networks fitted to them, and what replaces fits and renders of commands."""

from __future__ import annotations

import os
import signal
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commands import write_scene
from fitted_models import DRAFT
from synthetic import SyntheticRender, synthetic_render
from tungsten_dip.buffers.render_buffers import FloatImage, RenderBuffers
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.fit import FitResult, FitSettings, denoise
from tungsten_dip.fit.model import Model
from tungsten_dip.fit.preparation.exposure import exposure
from tungsten_dip.fit.result import HistoryPoint
from tungsten_dip.onnx import save_model
from tungsten_dip.progress import silent

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
    """Refuse to skip on a machine that is there to test everything; let tests send Ctrl-C."""
    # What a script starts in the background ignores it, and so does what that starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    missing = [name for name in OPTIONAL if find_spec(name) is None]
    if missing and os.environ.get("CI"):
        raise pytest.UsageError(f"CI is set, and {', '.join(missing)} is not installed")


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


@pytest.fixture
def oidn_images(monkeypatch: pytest.MonkeyPatch) -> list[FloatImage]:
    """Images of both halves that another denoiser is to return, in the units of the render."""
    images: list[FloatImage] = []
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: object())

    def given(buffers: RenderBuffers, colors: Any, threads: int) -> tuple[FloatImage, ...]:
        return tuple(image * np.float32(exposure(buffers.color)) for image in images)

    for module in ("evidence", "output.all_samples"):
        monkeypatch.setattr(f"tungsten_dip.fit.{module}.oidn_pilot", given)
    return images
