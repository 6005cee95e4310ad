"""The five tonemaps against values worked out by hand, and on everything a picture may hold."""

import numpy as np
import pytest

from tungsten_dip.errors import InputError
from tungsten_dip.scene.tonemap import display_from_radiance

TONEMAPS = ["linear", "gamma", "reinhard", "filmic", "pbrt"]


@pytest.mark.parametrize(
    ("tonemap", "radiance", "expected"),
    [
        ("linear", 0.25, 0.25),
        ("linear", 3.0, 1.0),
        ("gamma", 0.5, 0.5 ** (1 / 2.2)),
        ("reinhard", 1.0, 0.5 ** (1 / 2.2)),
        ("filmic", 0.004, 0.0),
        ("filmic", 1.004, 6.7 / 7.96),
        ("pbrt", 0.001, 0.01292),
        ("pbrt", 0.5, 1.055 * 0.5 ** (1 / 2.4) - 0.055),
    ],
)
def test_values(tonemap, radiance, expected):
    shown = display_from_radiance(np.full((1, 1, 3), radiance, np.float32), tonemap)
    np.testing.assert_allclose(shown, np.full((1, 1, 3), expected), rtol=1e-5)


@pytest.mark.parametrize("tonemap", TONEMAPS)
def test_rises_from_black_to_white_and_stays_within(tonemap):
    radiance = np.concatenate([[0.0], np.logspace(-6, 38, 500)]).astype(np.float32)
    shown = display_from_radiance(radiance, tonemap)
    assert shown.dtype == np.float32
    assert shown[0] == 0.0
    assert shown[-1] == pytest.approx(1.0, abs=1e-5)
    assert np.all(np.diff(shown) >= -1e-6)
    assert shown.max() <= 1.0


@pytest.mark.parametrize("tonemap", TONEMAPS)
def test_what_is_no_radiance_becomes_black_and_infinity_white(tonemap):
    shown = display_from_radiance(np.array([np.nan, -1.0, -np.inf, np.inf], np.float32), tonemap)
    np.testing.assert_allclose(shown, [0, 0, 0, 1], atol=1e-5)


@pytest.mark.parametrize("shape", [(0, 0, 3), (1, 1, 3), (3, 5, 3)])
def test_keeps_the_shape_and_the_input(shape):
    radiance = np.full(shape, 0.5, np.float32)
    assert display_from_radiance(radiance, "filmic").shape == shape
    assert np.all(radiance == 0.5)


def test_an_unknown_tonemap_is_refused():
    with pytest.raises(InputError, match="filmic"):
        display_from_radiance(np.zeros((1, 1, 3), np.float32), "aces")
