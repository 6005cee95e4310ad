"""What a result's error is estimated from, on images whose error is known, and when it is the input."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from synthetic import SyntheticRender
from tungsten_dip.buffers.render_buffers import Buffer, FloatArray, Halves
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.fit.candidates import Candidates
from tungsten_dip.fit.scoring.estimate import crossed_errors, estimate_error, held_out_error

PIXELS = 10_000
TRUTH = 1.0
RELATIVE = 1 / (TRUTH**2 + 0.01)


def _constant(value: float) -> Halves:
    image = np.full((PIXELS, 3), value, np.float32)
    return image, image


def _noisy(sigma: float, seed: int) -> Halves:
    rng = np.random.default_rng(seed)
    a, b = (np.float32(TRUTH + sigma * rng.standard_normal((PIXELS, 3))) for _ in range(2))
    return a, b


def _mean_estimate(noisy: Halves, apart: Sequence[float], denoised: Halves) -> float:
    """Return the mean error, with pilots that are so far from the truth."""
    pilots = tuple(_constant(TRUTH + distance) for distance in apart)
    errors: FloatArray = estimate_error(Candidates(noisy, pilots), 1.0, denoised)
    assert errors.shape == (PIXELS,)
    return float(errors.mean(dtype=np.float64))


def test_where_the_noisy_halves_tell_nothing_the_bias_is_between_variance_and_spread_of_pilots() -> None:
    denoised = _constant(TRUTH + 0.05)[0], _constant(TRUTH - 0.05)[0]
    expected = (0.05**2 + 2.4 * 0.05 * 0.2) * RELATIVE
    estimate = _mean_estimate(_noisy(30, seed=0), (0.1, -0.2, 0.3), denoised)
    assert estimate == pytest.approx(expected, rel=1e-3)


def test_pilots_that_blur_prove_no_bias_that_the_halves_deny() -> None:
    """The true error is next to nothing: no more than some standard errors of the halves' may be claimed."""
    sigma = 0.1
    denoised = _constant(TRUTH + 0.001)[0], _constant(TRUTH - 0.001)[0]
    standard_error = sigma**2 / np.sqrt(3 * PIXELS) * RELATIVE
    assert 0 < _mean_estimate(_noisy(sigma, seed=1), (0.5, 0.5, 0.5), denoised) < 8 * standard_error


def test_what_the_halves_tell_contains_the_variance() -> None:
    sigma = 0.1
    estimate = _mean_estimate(_noisy(0.05, seed=2), (0.5, 0.5, 0.5), _noisy(sigma, seed=3))
    assert estimate == pytest.approx(sigma**2 / 2 * RELATIVE, rel=0.1)


@pytest.mark.parametrize(("sigma", "bias"), [(0.1, 0.2), (2, 0.2), (30, 0.2)])
def test_the_held_out_error_is_told_by_the_halves_or_where_they_are_too_noisy_by_the_smallest_pilot(
    sigma: float, bias: float
) -> None:
    """Of the two, the other one would be far off."""
    smallest = _constant(TRUTH) if sigma > 1 else _constant(TRUTH + 5)
    error = held_out_error(Candidates(_noisy(sigma, seed=4), (smallest,)), _constant(TRUTH + bias))
    assert error == pytest.approx(bias**2 / ((TRUTH + bias) ** 2 + 0.01), rel=0.05)


def test_the_error_is_that_of_the_other_half_also_beside_bright_noise() -> None:
    """((f_a - b)^2 + (f_b - a)^2 - (a - b)^2) / 2, whose large squares would cancel in float32."""
    rng = np.random.default_rng(6)
    noisy = _noisy(1, seed=7)
    noisy[0][::2] = 1e6 * rng.random((PIXELS // 2, 3), np.float32)
    denoised = _noisy(0.1, seed=8)
    error_of_one_half, variance = crossed_errors(noisy, denoised)
    a, b, denoised_a, denoised_b = (image.astype(np.float64) for image in (*noisy, *denoised))
    exact = ((denoised_a - b) ** 2 + (denoised_b - a) ** 2 - (a - b) ** 2) / 2
    np.testing.assert_allclose(error_of_one_half, exact, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(variance, (denoised_a - denoised_b) ** 2 / 4, rtol=1e-5, atol=1e-6)


def test_an_input_as_good_as_what_is_fitted_to_it_is_returned(render: SyntheticRender) -> None:
    """Detail in every pixel that no feature shows, and little noise: every pilot blurs it."""
    rng = np.random.default_rng(5)
    truth = rng.uniform(0.1, 2, render.reference.shape)
    a, b = (np.float32(truth * (1 + 0.02 * rng.standard_normal(truth.shape))) for _ in range(2))
    variance = np.float32((0.02 * truth) ** 2 / 2)
    buffers = render.buffers.with_quantities(color=Buffer((a + b) / 2, a, b, variance))
    result = denoise(buffers, FitSettings("draft", iterations=1, threads=1))
    assert "the input is as good as anything fitted to it, and is returned" in result.notes
    np.testing.assert_array_equal(result.color, buffers.color.mean)
    assert result.halves is not None
    np.testing.assert_array_equal(result.halves, (a, b))
    noise = np.mean((a - b) ** 2 / 4 / (buffers.color.mean**2 + 0.01))
    assert result.estimated_relmse == pytest.approx(noise, rel=1e-3)
