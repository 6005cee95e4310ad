"""Light that a fit lost over an area is given back, as far as it is certain."""

from __future__ import annotations

import numpy as np
import pytest

from fitted_models import short
from synthetic import buffer_of_halves, rgb_from_plane
from tungsten_dip.buffers.render_buffers import FloatImage, Halves, RenderBuffers
from tungsten_dip.fit import denoise
from tungsten_dip.fit.output.lost_light import gain_of_lost_light

SHAPE = (60, 80, 3)


def _halves(truth: FloatImage, shape: float) -> Halves:
    rng = np.random.default_rng(0)
    a, b = (np.float32(truth * rng.gamma(shape, 1 / shape, truth.shape[:2])[..., None]) for _ in range(2))
    return a, b


@pytest.mark.parametrize(("kept", "least", "most"), [(1.0, 1, 1), (0.9, 1.05, 1 / 0.9), (1.1, 1, 1)])
def test_what_is_certain_of_the_missing_light_is_given_back(kept: float, least: float, most: float) -> None:
    truth = np.full(SHAPE, 0.3, np.float32)
    gain = gain_of_lost_light(_halves(truth, 2), truth * np.float32(kept), 1)
    assert least <= gain.mean() <= most
    assert gain.min() >= 1


def test_noise_gives_nothing_back() -> None:
    """The 9% that are missing are less than the noise of the mean."""
    truth = np.full(SHAPE, 0.3, np.float32)
    gain = gain_of_lost_light(_halves(truth, 1e-3), truth * np.float32(0.91), 1)
    assert gain.max() < 1.3
    assert gain.mean() < 1.02


def test_the_light_of_lamps_does_not_go_to_what_surrounds_them() -> None:
    """A tenth of a lamp is far more than all of the wall."""
    truth = np.full(SHAPE, 0.3, np.float32)
    truth[20:23, 20:23] = 500
    image = np.where(truth > 1, np.float32(0.9) * truth, truth)
    assert gain_of_lost_light((truth, truth), image, 1).max() < 1.01


def test_fine_dark_lines_that_no_feature_shows_do_not_darken_the_image() -> None:
    """They lost 7% of its radiance."""
    rows, columns = np.indices((96, 128))
    truth = rgb_from_plane(np.where((columns % 9 == 4) | (rows % 11 == 5), 0.02, 0.4))
    halves = _halves(truth, 8)
    result = denoise(RenderBuffers(buffer_of_halves(*halves)), short(preset="balanced", iterations=None))
    mean = (halves[0] + halves[1]).mean() / 2
    assert result.color.mean() == pytest.approx(mean, rel=0.03)
