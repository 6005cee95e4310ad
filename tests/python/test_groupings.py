"""Other groupings of the samples into halves, of which the preset final uses two."""

from __future__ import annotations

import signal
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fitted_models import check_result, short
from synthetic import SyntheticRender, relmse, synthetic_render
from tungsten_dip import _core
from tungsten_dip.buffers.render_buffers import Buffer, Halves, RenderBuffers
from tungsten_dip.fit import blending, denoise
from tungsten_dip.fit.network.blend_network import members_of
from tungsten_dip.fit.output.denoised import denoised_image, mean_of_images
from tungsten_dip.fit.preparation.splitting import HalvedImage, are_pixels_independent, regrouped
from tungsten_dip.fit.presets import RECIPES
from tungsten_dip.fit.result import DenoisedImage
from tungsten_dip.progress import Progress, silent


def _noise(seed: int, shape: tuple[int, int] = (64, 96)) -> Halves:
    rng = np.random.default_rng(seed)
    a, b = (rng.gamma(0.3, 1 / 0.3, (*shape, 3)).astype(np.float32) for _ in range(2))
    return a, b


def test_pixels_are_independent_unless_a_filter_adds_samples_to_several() -> None:
    for seed in range(20):
        assert are_pixels_independent(_noise(seed))
        splatted = tuple(_core.box_mean(half, 1, 1) for half in _noise(seed))
        assert not are_pixels_independent((splatted[0], splatted[1]))
        sharpened = tuple(half[:, 1:] - np.float32(0.5) * half[:, :-1] for half in _noise(seed))
        assert not are_pixels_independent((sharpened[0], sharpened[1]))
        rng = np.random.default_rng(seed)
        of_unequal_counts = tuple(
            rng.gamma(shape, 1 / shape, (64, 96, 3)).astype(np.float32) for shape in (0.1, 0.03)
        )
        assert are_pixels_independent((of_unequal_counts[0], of_unequal_counts[1]))
    flat = np.ones((3, 5, 3), np.float32)
    assert are_pixels_independent((flat, flat))
    assert are_pixels_independent((flat[:1, :1], 2 * flat[:1, :1]))


def test_a_grouping_swaps_all_halves_of_a_pixel_or_none(render: SyntheticRender) -> None:
    image = HalvedImage(render.buffers)
    other = regrouped(image, 0).buffers
    assert render.buffers.color.halves is not None
    assert other.color.halves is not None
    swapped = (other.color.halves[0] == render.buffers.color.halves[1]).all(axis=2, keepdims=True)
    assert 0.4 < swapped.mean() < 0.6
    for name, buffer in render.buffers.quantities():
        after = other.get(name)
        assert after is not None
        np.testing.assert_array_equal(after.mean, buffer.mean)
        if buffer.halves is not None and after.halves is not None:
            a, b = buffer.halves
            np.testing.assert_array_equal(after.halves[0], np.where(swapped, b, a))
            np.testing.assert_array_equal(after.halves[1], np.where(swapped, a, b))
    again, third = regrouped(image, 0).buffers, regrouped(image, 1).buffers
    np.testing.assert_array_equal(again.color.half_a, other.color.half_a)
    assert not np.array_equal(third.color.half_a, other.color.half_a)


def test_features_without_halves_stay_as_they_are() -> None:
    color, albedo = Buffer(_noise(0)[0], *_noise(0)), Buffer(_noise(1)[0])
    assert regrouped(HalvedImage(RenderBuffers(color, albedo)), 0).buffers.albedo is albedo


def test_two_groupings_err_less_than_one(monkeypatch: pytest.MonkeyPatch) -> None:
    renders = [synthetic_render(64, 48, seed=seed, spp=8) for seed in range(3)]

    def errors() -> list[float]:
        results = [denoise(r.buffers, short(preset="final", iterations=60, threads=2)) for r in renders]
        return [relmse(result.color, r.reference) for result, r in zip(results, renders, strict=True)]

    of_two = errors()
    monkeypatch.setitem(RECIPES, "final", replace(RECIPES["final"], regroups=False))
    assert np.mean(of_two) < np.mean(errors())


def test_an_image_whose_pixels_share_samples_has_one_grouping(
    render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    def splatted(buffer: Buffer) -> Buffer:
        return Buffer(*(_core.box_mean(plane, 1, 1) for _, plane in buffer.planes()))

    seeds = []

    def counted(image: HalvedImage, seed: int) -> HalvedImage:
        seeds.append(seed)
        return regrouped(image, seed)

    monkeypatch.setattr(blending, "regrouped", counted)
    for buffers in (render.buffers.with_quantities(color=splatted(render.buffers.color)), render.buffers):
        result = denoise(buffers, short(preset="final", iterations=3, seed=7))
        check_result(result, buffers)
        assert result.model is not None
        assert members_of(result.model.weights) == RECIPES["final"].members
    assert seeds == [7]


@pytest.mark.parametrize("when", ["pilot", "relMSE"])
def test_ctrl_c_in_the_second_grouping_leaves_the_first(when: str, render: SyntheticRender) -> None:
    def interrupt(fraction: float, message: str) -> None:
        if fraction > 0.55 and message.startswith(when):
            raise KeyboardInterrupt

    whole = denoise(render.buffers, short(preset="final"))
    result = denoise(render.buffers, short(preset="final"), interrupt)
    check_result(result, render.buffers)
    assert result.interrupted
    assert result.iterations == 30
    assert result.notes[-1] == "interrupted: the samples were grouped into halves once instead of twice"
    assert not np.array_equal(result.color, whole.color)
    assert result.model is not None
    assert members_of(result.model.weights) == 2


@pytest.mark.usefixtures("_sigint_interrupts")
@pytest.mark.parametrize("image", [1, 2])
def test_ctrl_c_while_an_image_is_made_keeps_it(
    image: int, render: SyntheticRender, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def interrupted(*arguments: Any) -> DenoisedImage:
        made.append(arguments)
        if len(made) == image:
            signal.raise_signal(signal.SIGINT)
        return denoised_image(*arguments)

    whole = denoise(render.buffers, short(preset="final"))
    monkeypatch.setattr(blending, "denoised_image", interrupted)
    result = denoise(render.buffers, short(preset="final"))
    check_result(result, render.buffers)
    assert result.interrupted
    assert result.model is not None
    assert members_of(result.model.weights) == 2 * image
    assert np.array_equal(result.color, whole.color) == (image == 2)
    assert any("once instead of twice" in note for note in result.notes) == (image == 1)


def test_the_target_error_ends_a_fit_before_the_second_grouping(render: SyntheticRender) -> None:
    told: list[float] = []

    def note(fraction: float, message: str) -> None:
        told.append(fraction)

    progress: Progress = note
    result = denoise(render.buffers, short(preset="final", target_error=10.0), progress)
    assert result.iterations == 1
    assert not result.interrupted
    assert [fraction for fraction in told if 0.5 < fraction < 1] == []
    assert denoise(render.buffers, short(preset="final"), silent).iterations == 30


def test_the_mean_of_images_has_the_mean_of_their_gains() -> None:
    def image(level: float, gain: float | None) -> DenoisedImage:
        color, ones = np.full((2, 3, 3), level, np.float32), np.ones((2, 3, 1), np.float32)
        return DenoisedImage(
            color * (gain or 1), (color, color), level * ones, level, None if gain is None else gain * ones
        )

    plain = mean_of_images([image(1, None), image(3, None)])
    np.testing.assert_array_equal(plain.color, np.full((2, 3, 3), 2))
    np.testing.assert_array_equal(plain.error, np.full((2, 3, 1), 2))
    assert plain.estimated_relmse == 2
    assert plain.gain is None
    brighter = mean_of_images([image(1, 1.5), image(3, None)])
    assert brighter.gain is not None
    np.testing.assert_allclose(brighter.gain, 1.25)
    np.testing.assert_allclose(brighter.color / brighter.gain, 2)
