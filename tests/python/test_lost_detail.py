"""Where the result yields to the noisy pixels: where light leaked, not where there is but noise."""

from __future__ import annotations

import numpy as np
import pytest

from fitted_models import evidence_of
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.fit.layout import Pilot
from tungsten_dip.fit.output.denoised import denoised_image
from tungsten_dip.fit.output.lost_detail import with_lost_detail

SHAPE = (40, 56, 3)


def _halves(truth: np.ndarray, shape: float = 4.0):
    rng = np.random.default_rng(0)
    a, b = ((truth * rng.gamma(shape, 1 / shape, truth.shape)).astype(np.float32) for _ in range(2))
    return a, b


def test_noise_around_a_good_result_changes_nothing_that_is_seen() -> None:
    truth = np.linspace(0.05, 2, SHAPE[1], dtype=np.float32)[None, :, None] * np.ones(SHAPE, np.float32)
    # Noise as that of paths which seldom find the light: most halves are black, some bright.
    for shape in (0.1, 0.5, 4.0):
        given = with_lost_detail(_halves(truth, shape), (truth, truth))
        for image in given:
            assert np.mean((image / truth - 1) ** 2) < 1e-3


@pytest.mark.parametrize(("lost", "leaked"), [(0.02, 0.2), (1.6, 0.2)])
def test_what_both_halves_show_is_given_back(lost: float, leaked: float) -> None:
    truth = np.full(SHAPE, 0.2, np.float32)
    truth[10:13, 20:24] = lost
    denoised = np.full(SHAPE, leaked, np.float32)
    given = with_lost_detail(_halves(truth, 32.0), (denoised, denoised))
    mean = (given[0] + given[1]) / 2
    np.testing.assert_allclose(mean[10:13, 20:24].mean(), lost, rtol=0.1)
    assert np.abs(mean[20:] - leaked).mean() < 0.002


def test_all_samples_keep_what_is_given_back() -> None:
    truth = np.full(SHAPE, 0.2, np.float32)
    truth[10:13, 20:24] = 1.6
    a, b = _halves(truth, 32.0)
    evidence, _ = evidence_of(RenderBuffers(Buffer((a + b) / 2, a, b)), (Pilot("features", 1),))
    flat = np.full(SHAPE, 0.2 * evidence.scale, np.float32)
    result = denoised_image(evidence, (flat, flat), flat)
    assert not any("is returned" in note for note in result.notes)
    assert result.color[10:13, 20:24].mean() > 1.4
    np.testing.assert_allclose(result.color, (result.halves[0] + result.halves[1]) / 2, rtol=1e-6)


def test_all_samples_make_nothing_negative_of_what_is_given_back_to_the_dark() -> None:
    truth = np.full(SHAPE, 0.2, np.float32)
    truth[10:20, 20:34] = 0.01
    a, b = _halves(truth, 32.0)
    evidence, _ = evidence_of(RenderBuffers(Buffer((a + b) / 2, a, b)), (Pilot("features", 1),))
    darker, brighter = (np.full(SHAPE, level * evidence.scale, np.float32) for level in (0.16, 0.24))
    dark = np.full(SHAPE, 0.02 * evidence.scale, np.float32)
    result = denoised_image(evidence, (darker, brighter), dark)
    assert not any("is returned" in note for note in result.notes)
    assert result.color[10:20, 20:34].mean() < 0.1
    assert result.color.min() >= 0


def test_nothing_is_given_back_on_the_word_of_one_half() -> None:
    truth = np.full(SHAPE, 0.2, np.float32)
    halves = _halves(truth, 32.0)
    halves[0][5, 5:15] *= 100
    given = with_lost_detail(halves, (truth, truth))
    np.testing.assert_array_equal(given[0], truth)
    np.testing.assert_array_equal(given[1], truth)


@pytest.mark.parametrize(("pixels", "given_back"), [(2, False), (12, True)])
def test_nothing_is_given_back_on_the_word_of_a_few_pixels(pixels: int, given_back: bool) -> None:
    """Both halves may have seen the same rare light by chance."""
    denoised = np.full(SHAPE, 0.2, np.float32)
    noisy = denoised.copy()
    noisy[5, 5 : 5 + pixels] = 3
    for image in with_lost_detail((noisy, noisy), (denoised, denoised)):
        np.testing.assert_allclose(image, noisy if given_back else denoised, rtol=1e-5)


def test_detail_is_given_back_to_the_dark_as_well() -> None:
    denoised = np.full(SHAPE, 0.01, np.float32)
    noisy = denoised.copy()
    noisy[5:8, 5:15] = 0.03
    for image in with_lost_detail((noisy, noisy), (denoised, denoised)):
        np.testing.assert_allclose(image, noisy, rtol=1e-5)


def test_pixels_that_no_sample_lit_are_not_confirmed_by_drawn_halves() -> None:
    denoised = np.full(SHAPE, 0.2, np.float32)
    halves = np.full(SHAPE, 0.3, np.float32), np.full(SHAPE, 0.25, np.float32)
    for half in halves:
        half[5:8, 5:15] = 0
    for image in with_lost_detail(halves, (denoised, denoised), drawn=True):
        assert image.min() == np.float32(0.2)
    assert with_lost_detail(halves, (denoised, denoised))[0].min() < 0.01


@pytest.mark.parametrize("size", [(1, 1, 3), (1, 9, 3), (7, 5, 3)])
@pytest.mark.parametrize("radiance", [0.0, 0.3, 1e15])
def test_any_size_and_radiance_stays_finite(size: tuple[int, ...], radiance: float) -> None:
    halves = np.full(size, radiance, np.float32), np.zeros(size, np.float32)
    for denoised in (np.zeros(size, np.float32), np.full(size, 1e15, np.float32)):
        for image in with_lost_detail(halves, (denoised, denoised.copy())):
            assert np.isfinite(image).all()
            assert (image >= 0).all()


def test_no_input_is_modified() -> None:
    halves, denoised = _halves(np.full(SHAPE, 0.01, np.float32)), _halves(np.full(SHAPE, 1.0, np.float32))
    copies = [image.copy() for image in (*halves, *denoised)]
    with_lost_detail(halves, denoised)
    for image, copy in zip((*halves, *denoised), copies, strict=True):
        np.testing.assert_array_equal(image, copy)
