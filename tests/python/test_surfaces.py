"""Features, albedo and emission of a half: lamps, stray light, and what halves may share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fitted_models import check_result, short, surfaces_of
from synthetic import SyntheticRender, buffer_of_halves, relmse, rgb_from_plane
from tungsten_dip.buffers.render_buffers import (
    CHANNELS,
    FEATURES,
    Buffer,
    FloatImage,
    Quantity,
    RenderBuffers,
)
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.fit.pilots.surfaces import Surfaces, divisor

Plane = np.ndarray


def _surfaces_of_lamps(
    emitted: tuple[Plane, Plane], seen: tuple[Plane, Plane] | None = None, wall: float = 0.5
) -> tuple[Surfaces, ...]:
    """Return the surfaces of a wall of radiance 0.3, and this albedo, before which light is emitted.

    ``emitted`` is what the albedo holds of it, ``seen`` what the colour does (None: the same).
    """
    albedo = [rgb_from_plane(np.where(light > 0, 1 + light, wall)) for light in emitted]
    color_a, color_b = (rgb_from_plane(0.3 + light) for light in seen or emitted)
    return surfaces_of(RenderBuffers(buffer_of_halves(color_a, color_b), albedo=buffer_of_halves(*albedo)))


@pytest.mark.parametrize("pixel", [(8, 9), (0, 9), (0, 0)])
def test_light_that_neither_the_other_half_nor_pixels_around_see_is_stray(pixel: tuple[int, int]) -> None:
    a, b = np.zeros((2, 20, 24))
    row, column = pixel
    a[pixel] = 30
    assert all(surfaces.emission.max() <= 1e-4 for surfaces in _surfaces_of_lamps((a, b)))
    b[pixel] = 0.05
    assert _surfaces_of_lamps((a, b))[0].emission.max() == pytest.approx(0.2, rel=1e-3)
    b[pixel] = 10
    assert _surfaces_of_lamps((a, b))[0].emission.max() == pytest.approx(30, rel=1e-5)
    b[pixel] = 0
    a[row + 1, column] = 30
    assert _surfaces_of_lamps((a, b))[0].emission.max() < 30
    b[row + 1, column + 1] = 30
    assert _surfaces_of_lamps((a, b))[0].emission.max() == pytest.approx(30, rel=1e-5)


@pytest.mark.parametrize(("hit", "stray"), [(0.03, True), (0.5, False)])
def test_light_that_the_halves_see_in_different_pixels_is_stray(hit: float, stray: bool) -> None:
    """Glass through which some paths hit a lamp by chance, in some pixels with both halves."""
    rng = np.random.default_rng(0)
    a, b = 30.0 * (rng.random((2, 40, 50)) < hit)
    assert ((a > 0) & (b > 0)).any()
    for surfaces, emitted in zip(_surfaces_of_lamps((a, b)), (a, b), strict=True):
        kept = (surfaces.emission[emitted > 0] > 0).mean()
        assert kept < 0.05 if stray else kept > 0.95


def test_the_sun_is_not_smeared_over_the_sky() -> None:
    """The sky emits too, a little."""
    sky = np.full((40, 48), 2.0)
    sky[20:22, 30:32] = 5e4
    for surfaces in _surfaces_of_lamps((sky, sky)):
        beside = surfaces.smooth_emission[sky == 2]
        assert beside.max() <= 4 * 2 + 1e-5
        assert surfaces.smooth_emission[sky > 2].min() > 0.5 * 5e4


def test_light_that_the_colour_does_not_hold_is_an_outlier() -> None:
    light = np.zeros((20, 24))
    light[8:12, 9:14] = 1000.0
    for surfaces in _surfaces_of_lamps((light, light), (0 * light, 0 * light)):
        assert surfaces.emission.max() <= 0.3 + 1e-5
    for surfaces in _surfaces_of_lamps((light, light)):
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
        for surfaces in _surfaces_of_lamps((a, b), wall=wall):
            errors.append(np.mean((surfaces.smooth_emission - rgb_from_plane(30 * cover)) ** 2))
            noise.append(np.mean((surfaces.emission - rgb_from_plane(30 * cover)) ** 2))
    assert np.mean(errors) < 0.5 * np.mean(noise)


def test_what_a_mirror_shows_is_not_divided_by_its_black_albedo() -> None:
    albedo = np.array([[[0.5] * 3, [0.0] * 3, [0.0005] * 3]], np.float32)
    np.testing.assert_allclose(divisor(albedo)[0, :, 0], [0.51, 1, 1])


def test_constant_features_do_not_reach_the_regression(render: SyntheticRender) -> None:
    assert [surfaces.features.shape for surfaces in surfaces_of(render.buffers)] == [(40, 56, 7)] * 2

    def flattened(name: str, channels: list[int]) -> Buffer:
        planes = {}
        for plane, array in getattr(render.buffers, name).planes():
            planes[plane] = array.copy()
            planes[plane][:, :, channels] = 0 if plane == "variance" else 0.25
        return Buffer(**planes)

    buffers = render.buffers.with_quantities(
        albedo=flattened("albedo", [0, 1, 2]), normal=flattened("normal", [1]), depth=flattened("depth", [0])
    )
    for surfaces in surfaces_of(buffers):
        assert surfaces.features.shape == (40, 56, 2)
        assert len(surfaces.penalty) == 2
        assert (np.ptp(surfaces.features, axis=(0, 1)) > 0).all()
    check_result(denoise(buffers, short(iterations=2)), buffers)
    channels = {"albedo": [0, 1, 2], "normal": [0, 1, 2], "depth": [0]}
    nothing = render.buffers.with_quantities(**{name: flattened(name, of) for name, of in channels.items()})
    assert [surfaces.features.shape for surfaces in surfaces_of(nothing)] == [(40, 56, 0)] * 2
    check_result(denoise(nothing, short(iterations=2)), nothing)


def test_surfaces_of_a_half_take_nothing_but_weights_from_the_other(render: SyntheticRender) -> None:
    """What a half's features share with the colour that scores it would pass for truth."""

    def darkened(half: str) -> RenderBuffers:
        # Albedos lower in one half by less than their noise: the pre-filter's weights hardly change.
        albedo = render.buffers.albedo
        assert albedo is not None
        image = getattr(albedo, half)
        assert image is not None
        return render.buffers.with_quantities(albedo=replace(albedo, **{half: np.float32(0.98) * image}))

    plain, changed = surfaces_of(render.buffers), surfaces_of(darkened("half_b"))
    assert np.abs(changed[1].albedo / plain[1].albedo - 1).mean() > 0.015
    assert np.abs(changed[0].albedo / plain[0].albedo - 1).mean() < 0.0025


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
    image = denoise(buffers, short(iterations=20)).color
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
    for surfaces in surfaces_of(RenderBuffers(lamp, albedo=lamp)):
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
        found = [s.emission[20, 30].mean() for s in surfaces_of(with_lamp(*halves))]
        np.testing.assert_allclose(found, emission, rtol=0.05, atol=1e-5)
    image = denoise(with_lamp("half_a"), short(iterations=20)).color
    around = np.delete(image[18:23, 28:33].reshape(25, 3), 12, axis=0)
    assert image[20, 30].mean() < 2 * around.mean()


@pytest.mark.parametrize("feature", FEATURES)
def test_every_feature_distinguishes_surfaces(feature: Quantity) -> None:
    image = np.random.default_rng(0).uniform(0.1, 0.9, (20, 24, CHANNELS[feature])).astype(np.float32)
    grey = rgb_from_plane(np.full((20, 24), 0.5))
    buffers = RenderBuffers(buffer_of_halves(grey, grey))
    buffers = buffers.with_quantities(**{feature: buffer_of_halves(image, image)})
    for surfaces in surfaces_of(buffers):
        assert [name.partition(".")[0] for name in surfaces.names] == [feature] * CHANNELS[feature]
