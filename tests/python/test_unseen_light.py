"""Light that was smeared into pixels none of whose samples saw it is taken away."""

from __future__ import annotations

import numpy as np
import pytest

from synthetic import relmse
from tungsten_dip.buffers.render_buffers import FloatImage, Halves
from tungsten_dip.fit.output.unseen_light import without_unseen_light

DARK, SKY = 0.01, 12.0


def _columns(part: FloatImage, samples: int, seed: int) -> tuple[Halves, Halves]:
    """Return the noisy halves, and the light in them, where a light fills a part of each pixel."""
    rng = np.random.default_rng(seed)
    lights = [rng.binomial(samples // 2, part)[..., None] / (samples / 2) * SKY for _ in range(2)]
    a, b = (np.float32(light + DARK).repeat(3, axis=2) for light in lights)
    return (a, b), (np.float32(lights[0]), np.float32(lights[1]))


def _smeared(without_light: float, seed: int) -> tuple[FloatImage, FloatImage, FloatImage]:
    """Return the truth, a result in which light fills half of every third column, and what becomes of it."""
    part = np.tile(np.float32([0, 0.5, 1]), (60, 30))
    result = np.float32(part * SKY + DARK)[..., None].repeat(3, axis=2)
    missing = np.random.default_rng(seed).random(part.shape) < without_light
    part[missing & (part < 1)] = 0
    noisy, light = _columns(part, 8, seed)
    halves, image = without_unseen_light(noisy, (result, result), result, light, 2)
    assert all((half <= result).all() for half in halves)
    return np.float32(part * SKY + DARK)[..., None].repeat(3, axis=2), result, image


@pytest.mark.parametrize("seed", range(5))
def test_light_that_both_halves_miss_too_often_is_not_there(seed: int) -> None:
    truth, result, image = _smeared(0.3, seed)
    assert relmse(image, truth) < 0.1 * relmse(result, truth)
    unseen = (truth == np.float32(DARK)) & (result > 1)
    assert image[unseen].mean() < 0.1 * SKY / 2
    assert np.abs(image - result)[~unseen].mean() < 0.01 * SKY


@pytest.mark.parametrize("seed", range(5))
def test_light_that_is_missed_as_often_as_its_part_tells_stays(seed: int) -> None:
    _, result, image = _smeared(0, seed)
    np.testing.assert_array_equal(image, result)


@pytest.mark.parametrize("hits", [0.3, 0.6, 1.0, 2.0])
def test_a_lamp_that_plastic_reflects_in_some_samples_stays(hits: float) -> None:
    """Where few pixels saw it, the others are no gaps, whatever the rims of lamps elsewhere show."""
    part = np.tile(np.float32([0, 0.5, 1]), (60, 30))
    plastic = np.indices(part.shape)[1] >= 45
    part[plastic] = hits / 8
    result = np.float32(part * SKY + DARK)[..., None].repeat(3, axis=2)
    for seed in range(3):
        noisy, light = _columns(part, 8, seed)
        _, image = without_unseen_light(noisy, (result, result), result, light, 2)
        assert np.abs(image - result)[plastic].mean() < 0.02 * result[plastic].mean()


def test_an_image_without_rims_stays() -> None:
    dark, lamp = (np.full((1, 1, 3), value, np.float32) for value in (DARK, SKY))
    for image in (dark, lamp):
        light = np.maximum(image[..., :1] - 1, 0)
        halves, result = without_unseen_light((image, image), (image, image), image, (light, light), 2)
        np.testing.assert_array_equal(result, image)
        np.testing.assert_array_equal(halves, (image, image))
