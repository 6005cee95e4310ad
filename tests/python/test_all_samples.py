"""All samples move the halves' result as far as the halves allow."""

import numpy as np
import pytest

from tungsten_dip.fit.output.all_samples import with_all_samples

SHAPE = (9, 14, 3)


def test_what_says_the_same_moves_nothing() -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.random(SHAPE, np.float32) for _ in range(2))
    np.testing.assert_array_equal(with_all_samples((a, b), (a + b) / 2, 1), (a + b) / 2)


def test_where_halves_agree_nothing_is_believed_that_only_the_mean_shows() -> None:
    same = np.full(SHAPE, 0.5, np.float32)
    whole = same.copy()
    whole[4, 4] = 1e6
    np.testing.assert_array_equal(with_all_samples((same, same), whole, 1), same)


def test_halves_that_differ_a_little_are_followed_by_what_they_differ() -> None:
    a, b = np.full(SHAPE, 0.99, np.float32), np.full(SHAPE, 1.01, np.float32)
    moved = with_all_samples((a, b), np.full(SHAPE, 7, np.float32), 1)
    # Spread 0.01 of level 1: a share of 0.25^2 / (0.25^2 + 0.01^2).
    np.testing.assert_allclose(moved, 1 + 0.01 * 0.0625 / 0.0626, rtol=1e-6)


def test_halves_that_differ_by_much_are_not_followed() -> None:
    a, b = np.zeros(SHAPE, np.float32), np.full(SHAPE, 2, np.float32)
    moved = with_all_samples((a, b), np.full(SHAPE, 7, np.float32), 1)
    np.testing.assert_allclose(moved, 1 + 0.0625 / 1.0625, rtol=1e-6)


@pytest.mark.parametrize("scale", [2.0**-20, 2.0**40])
def test_exposure_does_not_matter(scale: float) -> None:
    rng = np.random.default_rng(1)
    a, b, whole = (rng.random(SHAPE, np.float32) for _ in range(3))
    factor = np.float32(scale)
    scaled = with_all_samples((factor * a, factor * b), factor * whole, 2)
    np.testing.assert_allclose(scaled / factor, with_all_samples((a, b), whole, 2), rtol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 7, 3), (5, 1, 3)])
def test_black_stays_black(shape: tuple[int, ...]) -> None:
    black = np.zeros(shape, np.float32)
    np.testing.assert_array_equal(with_all_samples((black, black), black, 1), black)
