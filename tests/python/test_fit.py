"""Blends of pilots: closer to the truth than their input, honest about their error, safe with any input."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from concurrent.futures import wait
from dataclasses import replace
from pathlib import Path
from threading import Event, main_thread
from typing import Any, Literal

import numpy as np
import pytest

from conftest import MakeRender, SyntheticRender, relmse
from fitted_models import check_result
from tungsten_dip import interrupts
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.buffers.write import write_denoised
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitSettings, blending, denoise
from tungsten_dip.fit.blending import fit_blend
from tungsten_dip.fit.layout import Pilot
from tungsten_dip.fit.network import training
from tungsten_dip.fit.network.blend_network import Examples
from tungsten_dip.fit.network.training import Training, _batches
from tungsten_dip.fit.output.all_samples import pilots_of_all_samples
from tungsten_dip.fit.pilots.maker import PilotMaker, first_guides
from tungsten_dip.fit.pilots.surfaces import Surfaces, surfaces_of_colors
from tungsten_dip.fit.preparation.prepare import prepare_input
from tungsten_dip.fit.presets import BALANCED_PILOTS, DRAFT_PILOTS
from tungsten_dip.progress import silent


def _settings(**changes: Any) -> FitSettings:
    return FitSettings(**{"preset": "draft", "iterations": 30, "threads": 1, "device": "cpu", **changes})


def _halved(color: FloatImage, relative_noise: float, seed: int = 0) -> Buffer:
    """Independent halves of a noise-free colour."""
    rng = np.random.default_rng(seed)
    half_a, half_b = (
        (color * (1 + relative_noise * rng.standard_normal(color.shape))).astype(np.float32) for _ in range(2)
    )
    return Buffer((half_a + half_b) / 2, half_a, half_b)


@pytest.mark.parametrize(
    ("preset", "spp", "factor"),
    [("draft", 4, 20), ("draft", 16, 20), ("draft", 64, 12), ("balanced", 16, 25), ("final", 16, 25)],
)
def test_error_falls_and_is_estimated(preset: str, spp: int, factor: float, make_render: MakeRender) -> None:
    render = make_render(spp=spp)
    result = denoise(render.buffers, _settings(preset=preset, iterations=60))
    check_result(result, render.buffers)
    error = relmse(result.color, render.reference)
    assert error < relmse(render.buffers.color.mean, render.reference) / factor
    assert result.estimated_relmse is not None
    # Some thousand pixels do not tell it well.
    assert error / 2 < result.estimated_relmse < 6 * error
    assert result.iterations == 60
    assert [point.iteration for point in result.history] == sorted(
        point.iteration for point in result.history
    )
    assert result.history[-1].iteration == 60


def test_mean_radiance_is_kept(make_render: MakeRender) -> None:
    render = make_render(height=60, width=80, spp=16)
    result = denoise(render.buffers, _settings())
    assert result.color.mean() == pytest.approx(render.reference.mean(), rel=0.02)


def test_same_seed_same_bits_whatever_the_threads(render: SyntheticRender) -> None:
    first, again, other = (
        denoise(render.buffers, _settings(preset="balanced", seed=seed, threads=threads)).color
        for seed, threads in ((3, 1), (3, 2), (4, 2))
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@pytest.mark.parametrize("exponent", [-20, -3, 5, 30])
def test_exposure_changes_nothing_but_the_exposure(exponent: int, render: SyntheticRender) -> None:
    scale = np.float32(2.0**exponent)
    color = render.buffers.color
    assert color.half_a is not None
    assert color.half_b is not None
    assert color.variance is not None
    brighter = Buffer(
        color.mean * scale, color.half_a * scale, color.half_b * scale, color.variance * scale**2
    )
    # Albedos above 1 are emitted light, in the unit of the colour.
    albedo = render.buffers.albedo
    assert albedo is not None
    unlit = Buffer(**{name: np.minimum(image, 1) for name, image in albedo.planes()})
    plain = denoise(render.buffers.with_quantities(albedo=unlit), _settings())
    scaled = denoise(render.buffers.with_quantities(albedo=unlit, color=brighter), _settings())
    np.testing.assert_array_equal(scaled.color, plain.color * scale)
    assert scaled.estimated_relmse is not None
    assert plain.estimated_relmse is not None
    # The 0.01 of the relMSE is in the unit of the colour.
    assert (scaled.estimated_relmse > plain.estimated_relmse) == (exponent > 0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("exponent", [-126, -80, 80, 98])
def test_any_exposure_is_denoised_without_overflow(exponent: int, render: SyntheticRender) -> None:
    color = render.buffers.color
    planes = {
        name: np.ldexp(plane, 2 * exponent if name == "variance" else exponent)
        for name, plane in color.planes()
        if name != "variance" or abs(exponent) < 60
    }
    # A variance that float32 can hold beside any colour.
    planes.setdefault("variance", np.full_like(color.mean, 1e-38 if exponent < 0 else 1e38))
    result = denoise(render.buffers.with_quantities(color=Buffer(**planes)), _settings(iterations=5))
    assert np.isfinite(result.color).all()
    kept, given = (image.mean(dtype=np.float64) for image in (result.color, planes["mean"]))
    assert kept == pytest.approx(given, rel=0.1)


@pytest.mark.parametrize("exponent", [-118, -130])
def test_images_near_the_smallest_numbers_are_denoised(exponent: int, render: SyntheticRender) -> None:
    dark = [np.ldexp(image, exponent) for image in (render.buffers.color.mean, *render.buffers.color.halves)]
    result = denoise(render.buffers.with_quantities(color=Buffer(*dark)), _settings())
    noisy, denoised = (
        np.mean((np.ldexp(image, -exponent) - render.reference) ** 2) for image in (dark[0], result.color)
    )
    assert denoised < 0.2 * noisy


def test_dark_images_are_not_taken_for_clean_ones(render: SyntheticRender) -> None:
    """Without halves to trust, the exposure changes nothing either."""
    color, scale = render.buffers.color, np.float32(2.0**-21)
    noise = (color.mean - render.reference) / 2
    a, b = color.mean + noise, color.mean + noise / 2
    images = [
        denoise(RenderBuffers(Buffer((a + b) / 2 * s, a * s, b * s)), _settings()).color for s in (1, scale)
    ]
    assert np.abs(images[0] / ((a + b) / 2) - 1).max() > 0.1
    np.testing.assert_array_equal(images[1], images[0] * scale)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (7, 5), (33, 17)])
@pytest.mark.parametrize("halves", [True, False])
def test_any_size(size: tuple[int, int], halves: bool, make_render: MakeRender) -> None:
    buffers = make_render(*size).buffers
    if not halves:
        buffers = buffers.with_quantities(color=Buffer(buffers.color.mean))
    result = denoise(buffers, _settings(iterations=3))
    check_result(result, buffers)


def test_an_empty_image_is_refused(make_render: MakeRender) -> None:
    color = Buffer(np.empty((0, 5, 3), np.float32))
    with pytest.raises(InputError, match="at least one pixel, got 5x0"):
        denoise(RenderBuffers(color), _settings())


def test_color_alone(render: SyntheticRender) -> None:
    buffers = RenderBuffers(render.buffers.color)
    result = denoise(buffers, _settings())
    check_result(result, buffers)
    assert any("no albedo, normal, depth" in note for note in result.notes)
    noisy = relmse(buffers.color.mean, render.reference)
    assert relmse(result.color, render.reference) < noisy / 1.4
    without_halves = RenderBuffers(Buffer(buffers.color.mean))
    result = denoise(without_halves, _settings())
    check_result(result, without_halves)
    assert relmse(result.color, render.reference) < 1.2 * noisy  # every edge passes for noise


@pytest.mark.parametrize("missing", ["albedo", "normal", "depth"])
def test_a_missing_feature_is_noted(missing: str, render: SyntheticRender) -> None:
    buffers = render.buffers.with_quantities(**{missing: None})
    result = denoise(buffers, _settings(iterations=5))
    check_result(result, buffers)
    assert any(note.startswith(f"no {missing}:") for note in result.notes)
    assert not any(note.startswith("no ") for note in denoise(render.buffers, _settings(iterations=1)).notes)


def test_without_halves_the_noise_is_split(render: SyntheticRender) -> None:
    color = render.buffers.color
    buffers = render.buffers.with_quantities(color=Buffer(color.mean))
    result = denoise(buffers, _settings())
    check_result(result, buffers)
    assert result.model is not None
    assert any("no half buffers that can be used: its noise" in note for note in result.notes)
    error = relmse(result.color, render.reference)
    assert error < relmse(color.mean, render.reference) / 8
    assert result.estimated_relmse is not None
    assert error / 4 < result.estimated_relmse < 4 * error
    assert (denoise(buffers, _settings()).color == result.color).all()


def test_without_halves_fireflies_are_limited_and_lamps_are_not(render: SyntheticRender) -> None:
    color, albedo = render.buffers.color.mean.copy(), np.full_like(render.buffers.color.mean, 0.5)
    color[10, 10] = 1e4
    color[29:32, 29:32] = albedo[29:32, 29:32] = 1e3  # in plain view
    result = denoise(RenderBuffers(Buffer(color), albedo=Buffer(albedo)), _settings())
    assert any(" limited, with " in note for note in result.notes)
    assert result.color[8:13, 8:13].max() < 100
    assert result.color[27:34, 27:34].sum() > 0.5 * color[29:32, 29:32].sum()


def test_copied_halves_are_replaced(render: SyntheticRender) -> None:
    mean = render.buffers.color.mean
    buffers = render.buffers.with_quantities(
        color=Buffer(mean, mean, mean.copy(), render.buffers.color.variance)
    )
    result = denoise(buffers, _settings())
    check_result(result, buffers)
    assert any("not independent" in note for note in result.notes)
    assert relmse(result.color, render.reference) < relmse(mean, render.reference) / 8


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 1e12, 1e30])
@pytest.mark.parametrize("halves", [True, False])
def test_what_no_renderer_can_mean_stays_out(value: float, halves: bool, make_render: MakeRender) -> None:
    buffers = make_render(20, 24).buffers
    rng = np.random.default_rng(5)
    broken = {}
    for name, buffer in buffers.quantities():
        planes = {plane: array.copy() for plane, array in buffer.planes()}
        if name == "color" and not halves:
            planes = {"mean": planes["mean"], "variance": planes["variance"]}
        for array in planes.values():
            array[rng.integers(20, size=2), rng.integers(24, size=2)] = value
        broken[name] = Buffer(**planes)
    result = denoise(buffers.with_quantities(**broken), _settings(iterations=5))
    check_result(result, buffers)
    assert result.color.max() < 2 * denoise(buffers, _settings(iterations=5)).color.max()


@pytest.mark.parametrize("value", [1e12, 1e30, 3e38])
def test_a_wild_albedo_is_not_smeared(value: float, render: SyntheticRender) -> None:
    assert render.buffers.albedo is not None
    planes = {name: array.copy() for name, array in render.buffers.albedo.planes()}
    for name in ("mean", "half_a"):
        planes[name][30, 40] = value
    result = denoise(render.buffers.with_quantities(albedo=Buffer(**planes)), _settings())
    check_result(result, render.buffers)
    noisy = relmse(render.buffers.color.mean, render.reference)
    assert relmse(result.color, render.reference) < noisy / 4


def test_a_firefly_leaves_no_blot(render: SyntheticRender) -> None:
    color = render.buffers.color
    assert color.half_a is not None
    assert color.half_b is not None
    half_a = color.half_a.copy()
    half_a[8, 9] = 1e7
    buffers = render.buffers.with_quantities(color=Buffer((half_a + color.half_b) / 2, half_a, color.half_b))
    result = denoise(buffers, _settings())
    check_result(result, buffers)
    assert any("1 firefly limited" in note for note in result.notes)
    assert relmse(result.color, render.reference) < relmse(color.mean, render.reference) / 4


def test_black_stays_black(render: SyntheticRender) -> None:
    black = np.zeros((12, 17, 3), np.float32)
    for color in (Buffer(black, black, black, black), Buffer(black)):
        buffers = RenderBuffers(color)
        result = denoise(buffers, _settings(iterations=3))
        check_result(result, buffers)
        np.testing.assert_array_equal(result.color, black)


@pytest.mark.parametrize("relative_noise", [1e-4, 1e-3])
def test_a_converged_image_is_left_nearly_alone(relative_noise: float, render: SyntheticRender) -> None:
    # Shadows that no feature shows: any filter alone would blur them.
    color = render.reference * (1 + 0.5 * np.sin(np.arange(56) * 0.9))[None, :, None]
    buffers = render.buffers.with_quantities(color=_halved(color.astype(np.float32), relative_noise))
    result = denoise(buffers, _settings())
    check_result(result, buffers)
    np.testing.assert_allclose(result.color, buffers.color.mean, rtol=1e-3)


def test_the_halves_of_the_result_are_what_its_mean_is_made_of(render: SyntheticRender) -> None:
    result = denoise(render.buffers, _settings())
    assert result.halves is not None
    np.testing.assert_allclose((result.halves[0] + result.halves[1]) / 2, result.color, rtol=1e-6, atol=1e-7)
    assert (result.halves[0] != result.halves[1]).any()


@pytest.fixture
def oidn_images(monkeypatch: pytest.MonkeyPatch) -> list[FloatImage]:
    """Images of both halves that another denoiser is to return, in the units of the render."""
    images: list[FloatImage] = []
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: object())

    def given(buffers: RenderBuffers, colors: Any, scale: float, threads: int) -> tuple[FloatImage, ...]:
        return tuple(image * np.float32(scale) for image in images)

    for module in ("evidence", "output.all_samples"):
        monkeypatch.setattr(f"tungsten_dip.fit.{module}.oidn_pilot", given)
    return images


def test_a_good_extra_pilot_is_used(render: SyntheticRender, oidn_images: list[FloatImage]) -> None:
    alone = denoise(render.buffers, _settings())
    truth = render.reference
    oidn_images[:] = truth, truth
    together = denoise(render.buffers, _settings(pilot="oidn"))
    check_result(together, render.buffers)
    assert relmse(together.color, truth) < relmse(alone.color, truth) / 2


def test_a_bad_extra_pilot_does_little_harm(render: SyntheticRender, oidn_images: list[FloatImage]) -> None:
    alone = denoise(render.buffers, _settings(iterations=80))
    oidn_images[:] = np.zeros_like(render.reference), 10 * render.reference
    together = denoise(render.buffers, _settings(iterations=80, pilot="oidn"))
    check_result(together, render.buffers)
    assert relmse(together.color, render.reference) < 1.3 * relmse(alone.color, render.reference)


def test_the_time_budget_ends_the_training(render: SyntheticRender) -> None:
    result = denoise(render.buffers, _settings(iterations=100_000, time_budget_s=1e-6))
    check_result(result, render.buffers)
    assert result.iterations == 1
    assert any("time budget" in note for note in result.notes)


def test_within_a_time_budget_the_pilots_of_draft_come_first(render: SyntheticRender) -> None:
    result = denoise(render.buffers, _settings(preset="balanced", iterations=2, time_budget_s=1e6))
    check_result(result, render.buffers)
    assert result.model is not None
    assert result.model.blend is not None
    pilots = result.model.blend.layout.pilots
    assert pilots[: len(DRAFT_PILOTS)] == DRAFT_PILOTS
    assert set(pilots) == {*DRAFT_PILOTS, *BALANCED_PILOTS}


def test_windows_as_large_as_the_image_are_left_out(make_render: MakeRender) -> None:
    render = make_render(height=32, width=48)
    result = denoise(render.buffers, _settings(preset="final", iterations=2))
    assert result.model is not None
    assert result.model.blend is not None
    assert result.model.blend.layout.pilots == BALANCED_PILOTS


def test_the_target_error_ends_the_training(render: SyntheticRender) -> None:
    result = denoise(render.buffers, _settings(iterations=100_000, target_error=0.5))
    check_result(result, render.buffers)
    assert result.iterations < 100
    assert any("target error" in note for note in result.notes)
    assert result.history[-1].estimated_relmse is not None
    assert result.history[-1].estimated_relmse <= 0.5


def test_ctrl_c_during_the_training_returns_what_was_reached(render: SyntheticRender) -> None:
    raised = []

    def interrupt(fraction: float, message: str) -> None:
        if message.startswith("relMSE") and not raised:
            raised.append(fraction)
            raise KeyboardInterrupt

    result = denoise(render.buffers, _settings(iterations=100_000), interrupt)
    assert len(raised) == 1
    check_result(result, render.buffers)
    assert result.interrupted
    assert any(note.startswith(f"interrupted at step {result.iterations}") for note in result.notes)
    assert 1 <= result.iterations < 1000


@pytest.fixture
def _sigint_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGINT, also where a background job was started with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_does_not_wait_for_the_pilots_of_all_samples(
    render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = []

    def until_given_up(*arguments: Any, **options: Any) -> tuple[FloatImage, ...]:
        told.append(options["given_up"].wait(timeout=60))
        made = pilots_of_all_samples(*arguments, **options)
        assert made == ()
        return made

    def interrupt(fraction: float, message: str) -> None:
        if message.startswith("relMSE"):
            raise KeyboardInterrupt

    monkeypatch.setattr(blending, "pilots_of_all_samples", until_given_up)
    result = denoise(render.buffers, _settings(preset="balanced", threads=2, iterations=100_000), interrupt)
    check_result(result, render.buffers)
    assert told == [True]
    assert result.interrupted
    assert any(note.endswith("the image is made of the halves alone") for note in result.notes)


def test_strands_before_nothing_are_found_by_alpha() -> None:
    """Without features, all that tells thin strands from noise is their coverage."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[0:72, 0:112].astype(np.float32)
    alpha = np.zeros((72, 112, 1), np.float32)
    for strand in range(24):
        at = rng.uniform(-20, 132) + rng.uniform(-0.5, 0.5) * rows + 4 * np.sin(rows / 12 + strand)
        alpha[..., 0] = np.maximum(alpha[..., 0], np.clip(1.2 - np.abs(columns - at), 0, 1))
    truth = alpha * np.array([0.6, 0.4, 0.25], np.float32)
    noisy = Buffer((truth * rng.gamma(10, 0.1, alpha.shape)).astype(np.float32))
    draft = FitSettings(preset="draft")
    result = denoise(RenderBuffers(noisy, alpha=alpha), draft)
    assert relmse(result.color, truth) < 0.7 * relmse(noisy.mean, truth)
    assert 0.93 < result.color.mean() / truth.mean() < 1.07
    assert any("alpha takes the albedo's place" in note for note in result.notes)
    assert result.model is not None
    assert result.model.inputs[0] == "alpha.A"
    hidden = denoise(RenderBuffers(noisy, alpha=np.ones_like(alpha)), draft)
    assert not any("alpha" in note for note in hidden.notes)


@pytest.mark.usefixtures("_sigint_interrupts")
@pytest.mark.parametrize("waits", [True, False])
def test_ctrl_c_after_the_training_leaves_what_was_trained(
    waits: bool, render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether the main thread waits for the pilots of all samples by then, or is about to."""
    waiting, told = Event(), []

    def wait_or_interrupt(*arguments: Any, **options: Any) -> Any:
        first = not waiting.is_set()
        waiting.set()
        if first and not waits:
            signal.raise_signal(signal.SIGINT)
        return wait(*arguments, **options)

    def after_training(*arguments: Any, **options: Any) -> tuple[FloatImage, ...]:
        told.append(waiting.wait(timeout=60))
        if waits:
            # Python raises it in the main thread, which waits for this one.
            signal.pthread_kill(main_thread().ident or 0, signal.SIGINT)
        told.append(options["given_up"].wait(timeout=60))
        return pilots_of_all_samples(*arguments, **options)

    monkeypatch.setattr(interrupts, "wait", wait_or_interrupt)
    monkeypatch.setattr(blending, "pilots_of_all_samples", after_training)
    result = denoise(render.buffers, _settings(preset="balanced", threads=2))
    check_result(result, render.buffers)
    assert told == [True, True]
    assert result.interrupted
    assert result.iterations == 30
    assert "interrupted after the training of 30 steps" in result.notes
    assert any(note.endswith("the image is made of the halves alone") for note in result.notes)


def test_ctrl_c_during_the_training_keeps_complete_pilots_of_all_samples(render: SyntheticRender) -> None:
    """With one thread they are computed before."""

    def interrupt(fraction: float, message: str) -> None:
        if message.startswith("relMSE"):
            raise KeyboardInterrupt

    settings = _settings(preset="balanced")
    result = denoise(render.buffers, settings, interrupt)
    whole = denoise(render.buffers, replace(settings, iterations=1))
    assert result.interrupted
    assert result.iterations == 1
    assert not any("halves alone" in note for note in result.notes)
    np.testing.assert_array_equal(result.color, whole.color)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_failure_beside_the_training_is_raised_when_it_is_waited_for(
    threads: int, render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = []

    def fail(*_: Any, **options: Any) -> tuple[FloatImage, ...]:
        raise InputError("a test's")

    def recorded(*arguments: Any) -> Training:
        trained.append(arguments)
        return training.train(*arguments)

    monkeypatch.setattr(blending, "pilots_of_all_samples", fail)
    monkeypatch.setattr(blending, "train", recorded)
    with pytest.raises(InputError, match="a test's"):
        denoise(render.buffers, _settings(preset="balanced", threads=threads))
    assert len(trained) == threads - 1


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_in_training_does_not_wait_for_the_pilots_of_all_samples(
    threads: int, render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> Training:
        raise InputError("a test's")

    def until_given_up(*_: Any, given_up: Event, **options: Any) -> tuple[FloatImage, ...]:
        assert threads == 1 or given_up.wait(timeout=60)
        return ()

    monkeypatch.setattr(blending, "train", fail)
    monkeypatch.setattr(blending, "pilots_of_all_samples", until_given_up)
    with pytest.raises(InputError, match="a test's"):
        denoise(render.buffers, _settings(preset="balanced", threads=threads))


def test_progress_never_falls_and_ends_at_one(render: SyntheticRender, oidn_images: list[FloatImage]) -> None:
    oidn_images[:] = render.reference, render.reference
    without_halves = RenderBuffers(Buffer(render.buffers.color.mean))
    for buffers, changes in (
        (render.buffers, {}),
        (render.buffers, {"target_error": 10.0}),
        (render.buffers, {"pilot": "oidn"}),
        (without_halves, {}),
    ):
        told: list[float] = []
        denoise(buffers, _settings(**changes), lambda fraction, _, told=told: told.append(fraction))
        assert told == sorted(told)
        assert told[-1] == 1


def test_inputs_stay_as_they_are(render: SyntheticRender) -> None:
    before = {
        (name, plane): array.tobytes()
        for name, buffer in render.buffers.quantities()
        for plane, array in buffer.planes()
    }
    denoise(render.buffers, _settings(iterations=2))
    for name, buffer in render.buffers.quantities():
        for plane, array in buffer.planes():
            assert array.tobytes() == before[name, plane]


def _surfaces(buffers: RenderBuffers) -> tuple[Surfaces, ...]:
    half_a, half_b = buffers.color.half_a, buffers.color.half_b
    assert half_a is not None
    assert half_b is not None
    return surfaces_of_colors(buffers, (half_a, half_b), 1.0, 1)


def test_constant_features_do_not_reach_the_regression(render: SyntheticRender) -> None:
    assert [surfaces.features.shape for surfaces in _surfaces(render.buffers)] == [(40, 56, 7)] * 2

    def flattened(name: str, channels: list[int]) -> Buffer:
        planes = {}
        for plane, array in getattr(render.buffers, name).planes():
            planes[plane] = array.copy()
            planes[plane][:, :, channels] = 0 if plane == "variance" else 0.25
        return Buffer(**planes)

    buffers = render.buffers.with_quantities(
        albedo=flattened("albedo", [0, 1, 2]), normal=flattened("normal", [1]), depth=flattened("depth", [0])
    )
    for surfaces in _surfaces(buffers):
        assert surfaces.features.shape == (40, 56, 2)
        assert len(surfaces.penalty) == 2
        assert (np.ptp(surfaces.features, axis=(0, 1)) > 0).all()
    check_result(denoise(buffers, _settings(iterations=2)), buffers)
    channels = {"albedo": [0, 1, 2], "normal": [0, 1, 2], "depth": [0]}
    nothing = render.buffers.with_quantities(**{name: flattened(name, of) for name, of in channels.items()})
    assert [surfaces.features.shape for surfaces in _surfaces(nothing)] == [(40, 56, 0)] * 2
    check_result(denoise(nothing, _settings(iterations=2)), nothing)


def test_surfaces_of_a_half_take_nothing_but_weights_from_the_other(render: SyntheticRender) -> None:
    """What a half's features share with the colour that scores it would pass for truth."""

    def darkened(half: str) -> RenderBuffers:
        # Albedos lower in one half by less than their noise: the pre-filter's weights hardly change.
        albedo = render.buffers.albedo
        assert albedo is not None
        image = getattr(albedo, half)
        assert image is not None
        return render.buffers.with_quantities(albedo=replace(albedo, **{half: np.float32(0.98) * image}))

    plain, changed = _surfaces(render.buffers), _surfaces(darkened("half_b"))
    assert np.abs(changed[1].albedo / plain[1].albedo - 1).mean() > 0.015
    assert np.abs(changed[0].albedo / plain[0].albedo - 1).mean() < 0.0025


def test_a_pilot_of_the_color_does_without_features(render: SyntheticRender) -> None:
    """In mirrors and glass features are noise: what one pilot makes of the colour must not show it."""
    rng = np.random.default_rng(0)

    def noise(feature: Buffer | None) -> Buffer:
        assert feature is not None
        return Buffer(*(rng.uniform(0, 1, feature.mean.shape).astype(np.float32) for _ in range(3)))

    def images(buffers: RenderBuffers, pilot: Pilot) -> tuple[FloatImage, ...]:
        color = buffers.color
        assert color.half_a is not None
        assert color.half_b is not None
        halves, surfaces = (color.half_a, color.half_b), _surfaces(buffers)
        return PilotMaker(halves, surfaces, first_guides(halves, surfaces, 1), 1).images(pilot)

    features = {name: noise(getattr(render.buffers, name)) for name in ("albedo", "normal", "depth")}
    noisy = render.buffers.with_quantities(**features)
    of_color, of_features = Pilot("color", 4, k=1.0), Pilot("guided", 4, k=1.0)
    alone = images(render.buffers.with_quantities(**dict.fromkeys(features)), of_color)
    np.testing.assert_array_equal(images(noisy, of_color), images(render.buffers, of_color))
    np.testing.assert_array_equal(images(noisy, of_color), alone)
    errors = [relmse(images(noisy, pilot)[0], render.reference) for pilot in (of_color, of_features)]
    assert errors[0] < 0.8 * errors[1]


def test_emitted_light_is_given_back(render: SyntheticRender) -> None:
    """A lamp that its albedo shows keeps its radiance, and what lies beside it stays dark."""
    lamp = np.zeros((40, 56, 1), np.float32)
    lamp[10:20, 15:35] = 30.0
    color, albedo = render.buffers.color, render.buffers.albedo
    assert albedo is not None

    def lit(buffer: Buffer) -> Buffer:
        planes = dict(buffer.planes())
        return Buffer(**{n: image if n == "variance" else image + lamp for n, image in planes.items()})

    buffers = render.buffers.with_quantities(color=lit(color), albedo=lit(albedo))
    image = denoise(buffers, _settings(iterations=20)).color
    np.testing.assert_allclose(image[11:19, 16:34].mean(), color.mean[11:19, 16:34].mean() + 30, rtol=0.02)
    far = np.ones(lamp.shape[:2], bool)
    far[8:22, 13:37] = False
    assert np.abs(image[far].mean() / color.mean[far].mean() - 1) < 0.05


def test_emission_spreads_beyond_straight_edges_only() -> None:
    lamps = np.zeros((30, 40, 1), np.float32)
    lamps[8, 8] = lamps[18:20, 8:10] = lamps[10:20, 20:30] = 1
    rng = np.random.default_rng(0)
    a, b = ((lamps * rng.uniform(20, 30, lamps.shape)).repeat(3, 2).astype(np.float32) for _ in range(2))
    lamp = Buffer((a + b) / 2, a, b)
    for surfaces in _surfaces(RenderBuffers(lamp, albedo=lamp)):
        spread = (surfaces.smooth_emission > 0).all(axis=2) & (lamps[:, :, 0] == 0)
        assert not spread[:, :18].any()
        assert spread[12:18, 19].all()
        assert not spread[:, :19].any()
        assert not spread[:, 31:].any()


def _lamps_of_few_pixels(seed: int) -> tuple[RenderBuffers, FloatImage]:
    """Four spp of 25 lamps of 1.5 x 1.5 pixels, 4000 times brighter than the wall; the truth."""
    rng = np.random.default_rng(seed)
    height, width, radiance, side = 72, 96, 40.0, 1.5
    coverage = np.zeros((height, width, 1))
    for cell in np.ndindex(5, 5):
        top, left = (np.array(cell) + rng.uniform(0.2, 0.8, 2)) * (height / 5, width / 5)
        rows, columns = (
            np.clip(np.minimum(np.arange(size) + 1, start + side) - np.maximum(np.arange(size), start), 0, 1)
            for size, start in ((height, top), (width, left))
        )
        coverage[:, :, 0] = np.maximum(coverage[:, :, 0], np.outer(rows, columns))
    hits = [rng.binomial(2, coverage) / 2 for _ in range(2)]

    def halved(of_wall: list[FloatImage] | list[float], of_lamps: float) -> Buffer:
        a, b = (
            ((1 - hit) * wall + of_lamps * hit).astype(np.float32).repeat(3, axis=2)
            for hit, wall in zip(hits, of_wall, strict=True)
        )
        return Buffer((a + b) / 2, a, b)

    wall = [rng.gamma(2, 0.005, coverage.shape).astype(np.float32) for _ in range(2)]
    towards = np.zeros((height, width, 3), np.float32)
    towards[:, :, 2] = 1
    buffers = RenderBuffers(
        halved(wall, radiance), albedo=halved([0.2, 0.2], radiance), normal=Buffer(towards)
    )
    truth = 0.01 * (1 - coverage) + radiance * coverage
    return buffers, truth.astype(np.float32).repeat(3, axis=2)


@pytest.mark.parametrize("preset", ["draft", "balanced"])
def test_lamps_of_few_pixels_do_not_light_the_wall_beside_them(preset: str) -> None:
    for seed in range(3):
        buffers, truth = _lamps_of_few_pixels(seed)
        result = denoise(buffers, FitSettings(preset=preset))
        assert relmse(result.color, truth) < relmse(buffers.color.mean, truth)


def test_light_that_one_half_saw_by_chance_is_noise(render: SyntheticRender) -> None:
    """A path that happens upon a lamp through glass must not leave a bright pixel."""

    def with_lamp(*halves: str) -> RenderBuffers:
        def lit(buffer: Buffer) -> Buffer:
            planes = {name: image.copy() for name, image in buffer.planes()}
            for half in halves:
                planes[half][20, 30] += 30
                planes["mean"][20, 30] += 15
            return Buffer(**planes)

        albedo = render.buffers.albedo
        assert albedo is not None
        return render.buffers.with_quantities(color=lit(render.buffers.color), albedo=lit(albedo))

    for halves, emission in ((("half_a",), [0.0, 0.0]), (("half_a", "half_b"), [30.0, 30.0])):
        found = [s.emission[20, 30].mean() for s in _surfaces(with_lamp(*halves))]
        np.testing.assert_allclose(found, emission, rtol=0.05, atol=1e-5)
    image = denoise(with_lamp("half_a"), _settings(iterations=20)).color
    around = np.delete(image[18:23, 28:33].reshape(25, 3), 12, axis=0)
    assert image[20, 30].mean() < 2 * around.mean()


@pytest.mark.parametrize(
    "changes",
    [
        {"iterations": 0},
        {"iterations": -3},
        {"time_budget_s": 0.0},
        {"time_budget_s": float("nan")},
        {"time_budget_s": float("inf")},
        {"target_error": 10**400},
        {"target_error": -1.0},
        {"threads": 0},
        {"channels": ()},
        {"channels": (8, 0)},
        {"channels": "8,16"},
        {"channels": 8},
        {"channels": (8,) * 9},
        {"channels": (8, 1 << 20)},
        {"iterations": 1.5},
        {"threads": 10**12},
        {"seed": -1},
        {"seed": None},
        {"preset": np.zeros((2, 2))},
        {"threads": np.zeros((2, 2))},
        {"time_budget_s": "3"},
        {"preset": "fast"},
        {"pilot": "OIDN"},
        {"device": "gpu"},
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any]) -> None:
    name = next(iter(changes))
    with pytest.raises(InputError, match=rf"^{name}: expected.*$") as caught:
        FitSettings(**changes)
    assert "\n" not in str(caught.value)


def test_settings_that_would_be_ignored_are_refused() -> None:
    with pytest.raises(InputError, match="network: only the preset paper leaves that open"):
        FitSettings("draft", network="resnet")
    assert FitSettings("paper", network="resnet").network == "resnet"


def test_numbers_of_numpy_are_settings_as_well(render: SyntheticRender, tmp_path: Path) -> None:
    settings = FitSettings(
        "draft", iterations=np.int32(2), seed=np.int64(3), target_error=np.float32(0.5), threads=np.int8(1)
    )
    assert [type(value) for value in (settings.iterations, settings.seed, settings.target_error)] == [
        int,
        int,
        float,
    ]
    write_denoised(tmp_path / "out.exr", denoise(render.buffers, settings), render.buffers)
    assert FitSettings("paper", channels=[np.int64(8), 16]).channels == (8, 16)


def test_settings_come_back_with_the_result(render: SyntheticRender) -> None:
    settings = _settings(iterations=1, seed=9)
    assert denoise(render.buffers, settings).settings == settings


def test_the_previous_frame_is_a_pilot_where_it_shows_something(render):
    """What is known of the image beats what the samples tell; where nothing is known, the samples do."""
    buffers, reference = render.buffers, render.reference
    height = buffers.height
    known = reference.copy()
    known[height // 2 :] = np.nan
    settings = FitSettings(preset="draft", threads=1)
    result = fit_blend(buffers, settings, silent, previous=(known, known))
    alone = denoise(buffers, settings)
    assert np.isfinite(result.color).all()
    assert result.model.blend.layout.extra_count == 1

    def error(image, rows):
        return float(np.mean((image[rows] - reference[rows]) ** 2))

    top, bottom = slice(0, height // 2 - 2), slice(height // 2 + 2, None)
    assert error(result.color, top) < 0.8 * error(alone.color, top)
    assert error(result.color, bottom) < 0.5 * error(buffers.color.mean, bottom)


def test_empty_space_stays_black_whatever_the_previous_frame_shows(render):
    buffers = render.buffers
    empty = np.zeros(buffers.color.mean.shape[:2], bool)
    empty[:20, :20] = True

    color, depth = buffers.color, buffers.depth
    assert color.halves is not None
    assert depth is not None
    a, b = (np.where(empty[:, :, None], np.float32(0), half) for half in color.halves)
    nothing = np.where(empty[:, :, None], np.float32(0), depth.mean)
    buffers = replace(buffers, color=Buffer((a + b) / 2, a, b), depth=Buffer(nothing))
    bright = np.full_like(render.reference, 2.0)
    settings = FitSettings(preset="draft", threads=1)
    result = fit_blend(buffers, settings, silent, previous=(bright, bright))
    assert not result.color[:17, :17].any()
    assert result.color[~empty].any()


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


@pytest.mark.parametrize("preset", ["draft", "paper"])
def test_no_light_where_nothing_is_covered(
    preset: Literal["draft", "paper"], render: SyntheticRender
) -> None:
    """Features are left out: alpha alone tells that there is nothing."""
    color = render.buffers.color
    rows, columns = np.indices(color.mean.shape[:2])
    covered = (rows - 20) ** 2 + (columns - 20) ** 2 < 150
    glow = (rows > 40) & (columns > 40)
    alpha = covered[:, :, None].astype(np.float32)
    light = (covered | glow)[:, :, None]
    planes = {name: np.where(light, plane, np.float32(0)) for name, plane in color.planes()}
    buffers = RenderBuffers(Buffer(**planes), alpha=alpha)
    settings = _settings() if preset == "draft" else FitSettings("paper", iterations=2, inputs="random")
    result = denoise(buffers, settings)
    for image in (result.color, *(result.halves or ())):
        assert (image[~(covered | glow)] == 0).all()
        assert (image[glow] > 0).all()


def test_halves_of_an_image_without_noise_are_copies(render: SyntheticRender) -> None:
    truth = render.reference
    half_a, half_b = truth, truth * np.float32(1.001)
    result = denoise(RenderBuffers(Buffer((half_a + half_b) / 2, half_a, half_b)), _settings())
    assert result.model is None
    assert result.halves is not None
    for half, given in zip(result.halves, (half_a, half_b), strict=True):
        np.testing.assert_array_equal(half, given)
        assert not np.shares_memory(half, given)


def test_a_colour_without_a_sane_pixel_is_told(
    render: SyntheticRender, caplog: pytest.LogCaptureFixture
) -> None:
    color = render.buffers.color
    nothing = np.full_like(color.mean, np.nan)
    halves = render.buffers.with_quantities(color=replace(color, mean=nothing))
    assert denoise(halves, _settings()).color.mean() == pytest.approx(color.mean.mean(), rel=0.05)
    assert "in every pixel" not in caplog.text
    assert denoise(render.buffers.with_quantities(color=Buffer(nothing)), _settings()).color.mean() < 1e-3
    assert "in every pixel" in caplog.text


@pytest.mark.parametrize("scale", [3.2, 100, 255])
@pytest.mark.parametrize("halves", [True, False])
def test_an_albedo_in_another_scale_is_left_out(
    scale: float, halves: bool, render: SyntheticRender, caplog: pytest.LogCaptureFixture
) -> None:
    planes = {name: plane for name, plane in render.buffers.albedo.planes() if halves or name == "mean"}
    scaled = Buffer(**{name: plane * np.float32(scale) for name, plane in planes.items()})
    result = denoise(render.buffers.with_quantities(albedo=scaled), _settings())
    [warning] = [record for record in caplog.records if record.levelname == "WARNING"]
    assert "expected 0 to 1" in warning.getMessage()
    without = denoise(render.buffers.with_quantities(albedo=None), _settings())
    np.testing.assert_array_equal(result.color, without.color)


@pytest.mark.parametrize("radiance", [1.5, 30.0])
def test_the_albedo_of_a_picture_full_of_light_is_used(
    radiance: float, render: SyntheticRender, caplog: pytest.LogCaptureFixture
) -> None:
    """A wide lamp or a bright sky: its albedo is its radiance, as is its colour."""
    buffers = {}
    lit = np.ones((40, 56, 1), bool)
    lit[10:20] = False
    for name in ("color", "albedo"):
        planes = getattr(render.buffers, name).planes()
        buffers[name] = Buffer(**{plane: np.where(lit, np.float32(radiance), x) for plane, x in planes})
    prepared = prepare_input(render.buffers.with_quantities(**buffers), 1)
    assert prepared.buffers.albedo is not None
    assert not caplog.text


@pytest.mark.parametrize(
    ("radiance", "albedo"),
    [
        pytest.param(0.45 * 5, 5.0, id="a lamp behind fog"),
        pytest.param(0.3, 1.2, id="an albedo of one noisy pixel"),
        pytest.param(np.nan, 5.0, id="a colour of NaN"),
    ],
)
def test_an_albedo_that_may_be_in_its_scale_is_used(
    radiance: float, albedo: float, caplog: pytest.LogCaptureFixture
) -> None:
    color, feature = (Buffer(np.full((1, 1, 3), value, np.float32)) for value in (radiance, albedo))
    assert prepare_input(RenderBuffers(color, feature), 1).buffers.albedo is not None
    assert "albedo" not in caplog.text


def test_small_images_are_no_worse_for_more_pilots(make_render: MakeRender) -> None:
    errors = []
    for preset in ("draft", "balanced"):
        renders = [make_render(64, 36, seed=seed) for seed in range(3)]
        results = [denoise(r.buffers, FitSettings(preset, threads=1)).color for r in renders]
        errors.append(np.mean([relmse(c, r.reference) for c, r in zip(results, renders, strict=True)]))
    assert errors[1] < 1.1 * errors[0]
