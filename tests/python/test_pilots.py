"""What pilots make of small scenes whose light is known: lamps, stray light, surfaces that look alike."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.fit.layout import Pilot
from tungsten_dip.fit.pilots.maker import PilotMaker, first_guides
from tungsten_dip.fit.pilots.surfaces import Surfaces, divisor, surfaces_of_colors

Plane = np.ndarray


def _rgb(plane: Plane) -> FloatImage:
    return np.repeat(plane[:, :, None], 3, axis=2).astype(np.float32)


def _buffer(half_a: FloatImage, half_b: FloatImage) -> Buffer:
    return Buffer((half_a + half_b) / 2, half_a, half_b)


def _surfaces(
    emitted: tuple[Plane, Plane], seen: tuple[Plane, Plane] | None = None, wall: float = 0.5
) -> tuple[Surfaces, ...]:
    """Return the surfaces of a wall of radiance 0.3, and this albedo, before which light is emitted.

    ``emitted`` is what the albedo holds of it, ``seen`` what the colour does (None: the same).
    """
    albedo = [_rgb(np.where(light > 0, 1 + light, wall)) for light in emitted]
    color_a, color_b = (_rgb(0.3 + light) for light in seen or emitted)
    buffers = RenderBuffers(_buffer(color_a, color_b), albedo=_buffer(*albedo))
    return surfaces_of_colors(buffers, (color_a, color_b), 1.0, 1)


@pytest.mark.parametrize("pixel", [(8, 9), (0, 9), (0, 0)])
def test_light_that_neither_the_other_half_nor_pixels_around_see_is_stray(pixel: tuple[int, int]) -> None:
    a, b = np.zeros((2, 20, 24))
    row, column = pixel
    a[pixel] = 30
    assert all(surfaces.emission.max() <= 1e-4 for surfaces in _surfaces((a, b)))
    b[pixel] = 0.05
    assert _surfaces((a, b))[0].emission.max() == pytest.approx(0.2, rel=1e-3)
    b[pixel] = 10
    assert _surfaces((a, b))[0].emission.max() == pytest.approx(30, rel=1e-5)
    b[pixel] = 0
    a[row + 1, column] = 30
    assert _surfaces((a, b))[0].emission.max() < 30
    b[row + 1, column + 1] = 30
    assert _surfaces((a, b))[0].emission.max() == pytest.approx(30, rel=1e-5)


def test_the_sun_is_not_smeared_over_the_sky() -> None:
    """The sky emits too, a little."""
    sky = np.full((40, 48), 2.0)
    sky[20:22, 30:32] = 5e4
    for surfaces in _surfaces((sky, sky)):
        beside = surfaces.smooth_emission[sky == 2]
        assert beside.max() <= 4 * 2 + 1e-5
        assert surfaces.smooth_emission[sky > 2].min() > 0.5 * 5e4


def test_light_that_the_colour_does_not_hold_is_an_outlier() -> None:
    light = np.zeros((20, 24))
    light[8:12, 9:14] = 1000.0
    for surfaces in _surfaces((light, light), (0 * light, 0 * light)):
        assert surfaces.emission.max() <= 0.3 + 1e-5
    for surfaces in _surfaces((light, light)):
        assert surfaces.emission.max() == pytest.approx(1000, rel=1e-5)


def _covered(angle: float, size: int = 48, subpixels: int = 16) -> Plane:
    """Which part of every pixel a lamp of 18x10 pixels covers, turned by an angle."""
    y, x = (np.indices((size * subpixels, size * subpixels)) + 0.5) / subpixels - size / 2
    across, along = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    inside = (np.abs(across) < 9) & (np.abs(along) < 5)
    return inside.reshape(size, subpixels, size, subpixels).mean(axis=(1, 3))


@pytest.mark.parametrize("wall", [0.5, 1.0])
def test_the_rim_of_a_lamp_loses_most_of_its_noise(wall: float) -> None:
    """Four samples of each half say which part of a pixel the lamp covers, also before a white wall."""
    errors, noise = [], []
    for seed in range(3):
        rng, cover = np.random.default_rng(seed), _covered(angle=0.3)
        a, b = (30 * rng.binomial(4, cover) / 4 for _ in range(2))
        for surfaces in _surfaces((a, b), wall=wall):
            errors.append(np.mean((surfaces.smooth_emission - _rgb(30 * cover)) ** 2))
            noise.append(np.mean((surfaces.emission - _rgb(30 * cover)) ** 2))
    assert np.mean(errors) < 0.5 * np.mean(noise)


def test_what_a_mirror_shows_is_not_divided_by_its_black_albedo() -> None:
    albedo = np.array([[[0.5] * 3, [0.0] * 3, [0.0005] * 3]], np.float32)
    np.testing.assert_allclose(divisor(albedo)[0, :, 0], [0.51, 1, 1])


def _noisy(truth: Plane, shape: float) -> tuple[FloatImage, FloatImage]:
    rng = np.random.default_rng(0)
    a, b = (_rgb(truth * rng.gamma(shape, 1 / shape, truth.shape)) for _ in range(2))
    return a, b


def test_a_dark_surface_lights_up_nothing_of_the_empty_space_around() -> None:
    """The irradiance of both is so low that a guide alone would mix them."""
    columns = np.indices((36, 48))[1]
    surface = (columns >= 16) & (columns < 32)
    halves = _noisy(np.where(surface, 0.03, 0), shape=0.2)
    depth = Buffer(np.where(surface, 2, 0)[:, :, None].astype(np.float32))
    surfaces = surfaces_of_colors(RenderBuffers(_buffer(*halves), depth=depth), halves, 1.0, 1)
    for image in PilotMaker(halves, surfaces, first_guides(halves, surfaces, 1), 1).images(
        Pilot("guided", 6, step=2, k=1.0)
    ):
        assert image[surface].mean() == pytest.approx(0.03, rel=0.1)
        assert image[~surface].max() < 1e-6


def test_the_previous_frame_guides_pilots_of_the_color() -> None:
    """It shows stripes of shadow that the noise hides."""
    truth = np.where(np.indices((36, 48))[1] // 4 % 2, 0.4, 0.1)
    halves, previous = _noisy(truth, shape=0.5), (_rgb(truth), _rgb(truth))
    surfaces = surfaces_of_colors(RenderBuffers(_buffer(*halves)), halves, 1.0, 1)
    alone = PilotMaker(halves, surfaces, first_guides(halves, surfaces, 1), 1)
    guided = replace(alone, previous=previous)
    errors = [
        np.mean((maker.images(Pilot("color", 4, k=1.0))[0] - _rgb(truth)) ** 2) for maker in (alone, guided)
    ]
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "guided"},
        {"kind": "color"},
        {"kind": "features", "k": 1.0},
        {"kind": "edges", "k": 1.0},
        {"kind": "edges", "step": 2},
        {"kind": "edges", "with_position": True},
        {"kind": "features", "step": 0},
        {"kind": "features", "step": 4},
        {"kind": "features", "step": 12},
    ],
)
def test_a_pilot_that_no_filter_computes_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Pilot(radius=6, **wrong)
