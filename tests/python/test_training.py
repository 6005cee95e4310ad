"""What a network is trained on, how fast, and with how many members."""

from __future__ import annotations

import numpy as np
import pytest

from fitted_models import check_result, evidence_of, short
from synthetic import SyntheticRender, relmse, synthetic_render
from tungsten_dip.fit import FitSettings, blending, denoise
from tungsten_dip.fit.network import training
from tungsten_dip.fit.network.blend_network import HIDDEN, BlendNetwork, Examples
from tungsten_dip.fit.network.training import LEARNING_RATE, _batches, start_of_training
from tungsten_dip.fit.presets import BALANCED_PILOTS, DRAFT_PILOTS, RECIPES
from tungsten_dip.fit.settings import Preset


def test_the_pixels_that_tell_the_error_are_not_trained_on(render: SyntheticRender) -> None:
    evidence, cues = evidence_of(render.buffers, DRAFT_PILOTS)
    start = start_of_training(evidence, cues, 0, None, 1)
    probe, trained = training._probe(start, np.random.default_rng(0))
    half_a = start.evidence.candidates.noisy[0].reshape(-1, 3)
    told = probe.candidates.noisy[0]
    assert len(told) == 40 * 56 // 8
    both = np.concatenate((told, half_a[trained]))
    np.testing.assert_array_equal(np.sort(both, axis=0), np.sort(half_a, axis=0))


class _Clock:
    """Each time it is asked, another fiftieth of the budget is spent."""

    def __init__(self, budget_s: float | None) -> None:
        self._asked = 0

    def seconds(self) -> float:
        return 0.0

    def share_spent(self) -> float:
        self._asked += 1
        return self._asked / 50


def test_steps_get_smaller_towards_the_end_of_the_time_budget(
    render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates: list[float] = []
    step = BlendNetwork.step

    def recorded(network: BlendNetwork, batch: Examples, learning_rate: float) -> None:
        rates.append(learning_rate)
        step(network, batch, learning_rate)

    monkeypatch.setattr(BlendNetwork, "step", recorded)
    monkeypatch.setattr(blending, "Clock", _Clock)
    result = denoise(
        render.buffers, FitSettings("draft", iterations=10**6, time_budget_s=1.0, threads=1, device="cpu")
    )
    assert any("the time budget is spent" in note for note in result.notes)
    assert len(rates) > 20
    assert max(rates) > 0.8 * LEARNING_RATE
    assert rates[10:] == sorted(rates[10:], reverse=True)
    assert rates[-1] < 0.02 * LEARNING_RATE


@pytest.mark.parametrize(
    ("preset", "time_budget_s", "members", "steps"),
    [("balanced", None, 2, 160), ("balanced", 1e6, 1, 240), ("final", None, 6, 240), ("final", 1e6, 1, 240)],
)
def test_a_time_budget_is_spent_on_one_network(
    preset: Preset, time_budget_s: float | None, members: int, steps: int
) -> None:
    result = denoise(
        synthetic_render(32, 32).buffers, FitSettings(preset, time_budget_s=time_budget_s, threads=1)
    )
    assert result.model is not None
    assert np.shape(result.model.weights["layer1.bias"]) == (members * HIDDEN,)
    assert result.iterations == steps


@pytest.mark.parametrize("preset", ["balanced", "final"])
def test_the_noise_of_few_pixels_is_not_learnt(preset: Preset) -> None:
    render = synthetic_render(16, 16, spp=8)
    fitted, longer = (
        denoise(render.buffers, FitSettings(preset, iterations=steps, threads=1))
        for steps in (None, RECIPES[preset].steps)
    )
    assert fitted.iterations < longer.iterations
    assert relmse(fitted.color, render.reference) < 0.9 * relmse(longer.color, render.reference)


def test_the_time_budget_ends_the_training(render: SyntheticRender) -> None:
    result = denoise(render.buffers, short(iterations=100_000, time_budget_s=1e-6))
    check_result(result, render.buffers)
    assert result.iterations == 1
    assert any("time budget" in note for note in result.notes)


def test_within_a_time_budget_the_pilots_of_draft_come_first(render: SyntheticRender) -> None:
    result = denoise(render.buffers, short(preset="balanced", iterations=2, time_budget_s=1e6))
    check_result(result, render.buffers)
    assert result.model is not None
    assert result.model.blend is not None
    pilots = result.model.blend.layout.pilots
    assert pilots[: len(DRAFT_PILOTS)] == DRAFT_PILOTS
    assert set(pilots) == {*DRAFT_PILOTS, *BALANCED_PILOTS}


def test_the_target_error_ends_the_training(render: SyntheticRender) -> None:
    result = denoise(render.buffers, short(iterations=100_000, target_error=0.5))
    check_result(result, render.buffers)
    assert result.iterations < 100
    assert any("target error" in note for note in result.notes)
    assert result.history[-1].estimated_relmse is not None
    assert result.history[-1].estimated_relmse <= 0.5


@pytest.mark.parametrize(("pixels", "size"), [(1, 16), (10, 4), (10, 7), (50, 1000)])
def test_batches_show_all_that_is_trained_on_and_nothing_else(
    pixels: int, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "_POOL_PIXELS", 12)
    numbers = np.arange(2 * pixels, dtype=np.float32)[:, None]
    examples = Examples(numbers, numbers[:, :, None], numbers, numbers)
    trained = np.arange(0, pixels, 2)
    batches = _batches(examples, trained, size, np.random.default_rng(0))
    seen: set[float] = set()
    for _ in range(200):
        batch = next(batches)
        assert len(batch.inputs) == min(size, 2 * len(trained))
        np.testing.assert_array_equal(batch.target, batch.inputs)
        seen |= set(batch.inputs.ravel().tolist())
    assert seen == {*trained, *(pixels + trained)}
