"""A fast slice of the hard cases, and gradients that are those of the losses.

`make stress` measures all of them, in every way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from hard_cases import CASES, HardCase, broken_renders, exposed, healthy, measure
from synthetic import synthetic_render
from tungsten_dip.buffers.half_buffers import compare_halves
from tungsten_dip.buffers.prefilter import prefilter_features
from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.buffers.sanitize import sanitize
from tungsten_dip.fit import FitResult, FitSettings, denoise
from tungsten_dip.onnx import infer

torch = pytest.importorskip("torch")

DRAFT = FitSettings(preset="draft", iterations=60, threads=1, device="cpu")
PAPER = FitSettings(preset="paper", iterations=3, channels=(4, 8), threads=1, device="cpu")

SLICE = [case for case in CASES if case.name not in ("31x1000", "8192x16")][::2]
"""Every other case: neighbours in the catalogue are alike."""

FEW = SLICE[::6]


@pytest.fixture(scope="module")
def undamaged() -> FitResult:
    """What becomes of the render that the cases damage."""
    return denoise(healthy().buffers, DRAFT)


def _by_name(case: HardCase) -> str:
    return f"{case.group}: {case.name}"


@pytest.mark.parametrize("case", SLICE, ids=_by_name)
def test_promises_hold(case: HardCase, undamaged: FitResult) -> None:
    damaged = case.make()
    same_picture = np.array_equal(damaged.reference, healthy().reference)
    outcome = measure(denoise(damaged.buffers, DRAFT), damaged, undamaged if same_picture else None)
    assert not outcome.broken(case)


@pytest.mark.parametrize("case", FEW, ids=_by_name)
def test_other_threads_same_bits(case: HardCase) -> None:
    buffers = case.make().buffers
    few = replace(DRAFT, iterations=10)
    first, again = (denoise(buffers, replace(few, threads=threads)).color for threads in (1, 3))
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("case", FEW, ids=_by_name)
@pytest.mark.parametrize("way", ["balanced", "final", "paper", "warm start", "onnxruntime"])
def test_every_way_stays_finite(way: str, case: HardCase, undamaged: FitResult) -> None:
    damaged = case.make()
    assert undamaged.model is not None
    few = replace(DRAFT, iterations=5)
    if case.group == "Features" and way in ("warm start", "onnxruntime") and "none" in case.name:
        pytest.skip("a network of other features is refused, which test_warm_start.py proves")
    ways: dict[str, Callable[[], FitResult]] = {
        "balanced": lambda: denoise(damaged.buffers, replace(few, preset="balanced")),
        "final": lambda: denoise(damaged.buffers, replace(few, preset="final")),
        "paper": lambda: denoise(damaged.buffers, PAPER),
        "warm start": lambda: denoise(damaged.buffers, few, warm_start=undamaged.model),
        "onnxruntime": lambda: infer(undamaged.model, damaged.buffers, threads=1, refit_steps=5),
    }
    assert measure(ways[way](), damaged).finite


@pytest.mark.parametrize("exponent", [-21, 13])
def test_halves_are_tested_alike_at_any_exposure(exponent: int) -> None:
    (case,) = (case for case in CASES if case.name == "halves correlated, +0.5")
    buffers = case.make().buffers
    here, there = (compare_halves(image, 1) for image in (buffers, exposed(buffers, exponent)))
    assert here.correlation == pytest.approx(there.correlation)
    assert not here.independent
    assert not there.independent


@pytest.mark.parametrize("preset", ["draft", "balanced", "final"])
def test_a_learning_rate_too_high_does_no_harm(preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tungsten_dip.fit.network.training.LEARNING_RATE", 1.0)
    result = denoise(healthy().buffers, replace(DRAFT, preset=preset))
    any_pilots = {"mean": "weights that jump about end at any blend of pilots"}
    assert not measure(result, healthy()).broken(HardCase("Settings", preset, healthy, any_pilots))


def test_the_published_method_survives_a_learning_rate_too_high(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tungsten_dip.fit.paper.fit.LEARNING_RATE", 0.1)
    assert measure(denoise(healthy().buffers, replace(PAPER, iterations=30)), healthy()).finite


@given(broken_renders())
@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
def test_whatever_comes_the_result_is_finite(buffers: RenderBuffers) -> None:
    result = denoise(buffers, replace(DRAFT, iterations=2))
    assert result.color.shape == buffers.color.mean.shape
    assert np.isfinite(result.color).all()
    assert (result.color >= 0).all()


# --- gradients against central differences, in double precision


@pytest.fixture
def double_precision():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("double_precision")
@pytest.mark.parametrize("network", ["skip", "resnet"])
def test_gradients_of_the_published_loss(network: str) -> None:
    from tungsten_dip.fit.paper.fit import PaperFit
    from tungsten_dip.fit.paper.images import paper_images

    images = paper_images(healthy().buffers, replace(PAPER, inputs="all"))
    small = replace(
        images,
        given=images.given[:16, :16].astype(np.float64),
        wanted=images.wanted[:16, :16].astype(np.float64),
    )
    fit = PaperFit(small, replace(PAPER, network=network, inputs="all"), torch.device("cpu"))
    fit.network.double()
    seen, wanted = fit._input.double(), fit._wanted.double()

    def loss() -> float:
        with torch.no_grad():
            return float(torch.nn.functional.mse_loss(fit.network(seen), wanted))

    torch.nn.functional.mse_loss(fit.network(seen), wanted).backward()
    checked = [p for p in fit.network.parameters() if p.grad is not None and p.grad.abs().max() > 1e-6]
    assert len(checked) > 5
    for parameter in checked[:: max(len(checked) // 6, 1)]:
        _check_gradient(parameter, parameter.grad, loss, entries=2)


def _check_gradient(parameter, gradient, loss: Callable[[], float], entries: int) -> None:
    """Compare the largest entries and some others with central differences."""
    step = 1e-6
    values, flat = parameter.data, gradient.reshape(-1)
    rng = np.random.default_rng(1)
    chosen = {int(flat.abs().argmax()), *map(int, rng.integers(len(flat), size=entries - 1))}
    for index in chosen:
        place = np.unravel_index(index, values.shape)
        known = float(values[place])
        losses = []
        for moved in (known + step, known - step):
            values[place] = moved
            losses.append(loss())
        values[place] = known
        expected = (losses[0] - losses[1]) / (2 * step)
        assert float(flat[index]) == pytest.approx(expected, rel=1e-4, abs=1e-4 * float(flat.abs().max()))


def test_a_depth_around_0_does_not_fall_below_it() -> None:
    buffers = synthetic_render(3, 2, 4).buffers.with_quantities(albedo=None, normal=None)
    depth = prefilter_features(sanitize(buffers, 1)[0], 1).depth
    assert depth is not None
    assert depth.mean.min() >= 0
    assert np.isfinite(denoise(buffers, replace(DRAFT, iterations=2)).color).all()
