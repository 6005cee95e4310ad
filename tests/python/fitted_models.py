"""Small fits and parts of them, for every test that fits, saves, loads, uses or goes on training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.fit import FitResult, FitSettings, denoise
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.evidence import Cues, Evidence, evidence_from_buffers
from tungsten_dip.fit.layout import Pilot
from tungsten_dip.fit.model import Model
from tungsten_dip.fit.pilots.surfaces import Surfaces, surfaces_of_colors
from tungsten_dip.fit.preparation.splitting import HalvedImage
from tungsten_dip.graphs.sessions import session_from_proto
from tungsten_dip.onnx.graph import graph_of
from tungsten_dip.progress import silent

DRAFT = FitSettings("draft", iterations=20, threads=1, device="cpu")


def short(**changes: Any) -> FitSettings:
    """Return the settings of a fit of 30 steps on one thread, by default of preset draft."""
    return FitSettings(**{"preset": "draft", "iterations": 30, "threads": 1, "device": "cpu", **changes})


def paper_model(network: str, buffers: RenderBuffers, **changes: Any) -> Model:
    """Return a network of the published method after one iteration; ``changes`` are of its settings."""
    chosen = {"channels": (4, 6, 8), "iterations": 1, "threads": 1, "device": "cpu", **changes}
    result = denoise(buffers, FitSettings("paper", network=network, **chosen))  # type: ignore[arg-type]
    assert result.model is not None
    return result.model


def session_of(model: Model) -> Any:
    """Return an onnxruntime session of the model's graph."""
    return session_from_proto(graph_of(model), 1)


def evidence_of(buffers: RenderBuffers, pilots: Sequence[Pilot]) -> tuple[Evidence, Cues]:
    """Return what a fit with these pilots knows of the buffers."""
    return evidence_from_buffers(HalvedImage(buffers), pilots, Clock(), silent, threads=1)


def surfaces_of(buffers: RenderBuffers) -> tuple[Surfaces, ...]:
    """Return the surfaces of both halves, in the units of the buffers."""
    assert buffers.color.halves is not None
    return surfaces_of_colors(buffers, buffers.color.halves, 1.0, 1)


def check_result(result: FitResult, buffers: RenderBuffers) -> None:
    """Assert what holds of every result."""
    assert result.color.shape == buffers.color.mean.shape
    assert result.color.dtype == np.float32
    assert np.isfinite(result.color).all()
    assert result.color.min(initial=0) >= 0
    assert (result.error is None) == (result.estimated_relmse is None)
    if result.error is not None and result.estimated_relmse is not None:
        assert result.error.shape == (*buffers.color.mean.shape[:2], 1)
        assert np.isfinite(result.error).all()
        assert result.error.min() >= 0
        assert np.isfinite(result.estimated_relmse)
