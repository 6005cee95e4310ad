"""What filters make of small scenes: dark surfaces, noisy features, shadows that only a guide shows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fitted_models import short, surfaces_of
from synthetic import SyntheticRender, buffer_of_halves, relmse, rgb_from_plane, synthetic_render
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.fit import denoise
from tungsten_dip.fit.layout import Pilot
from tungsten_dip.fit.pilots.maker import PilotMaker, guides_of_colors
from tungsten_dip.fit.presets import BALANCED_PILOTS

Plane = np.ndarray


def _noisy(truth: Plane, shape: float) -> tuple[FloatImage, FloatImage]:
    rng = np.random.default_rng(0)
    a, b = (rgb_from_plane(truth * rng.gamma(shape, 1 / shape, truth.shape)) for _ in range(2))
    return a, b


def test_a_dark_surface_lights_up_nothing_of_the_empty_space_around() -> None:
    """The irradiance of both is so low that a guide alone would mix them."""
    columns = np.indices((36, 48))[1]
    surface = (columns >= 16) & (columns < 32)
    halves = _noisy(np.where(surface, 0.03, 0), shape=0.2)
    depth = Buffer(np.where(surface, 2, 0)[:, :, None].astype(np.float32))
    surfaces = surfaces_of(RenderBuffers(buffer_of_halves(*halves), depth=depth))
    for image in PilotMaker(halves, surfaces, guides_of_colors(halves, surfaces, 1), 1).images(
        Pilot("guided", 6, step=2, k=1.0)
    ):
        assert image[surface].mean() == pytest.approx(0.03, rel=0.1)
        assert image[~surface].max() < 1e-6


def test_the_rim_of_a_bright_sky_is_not_frayed() -> None:
    """Colour and features of a pixel that the sky half fills depend on how many of its samples saw it."""
    rng = np.random.default_rng(0)
    part = np.tile(np.float32([1] * 20 + [0.5] + [0] * 19), (64, 1))
    sky = [rng.binomial(4, part) / 4 for _ in range(2)]
    halves = rgb_from_plane(0.02 + sky[0]), rgb_from_plane(0.02 + sky[1])
    depth = buffer_of_halves(*(np.float32(3 * (1 - seen))[:, :, None] for seen in sky))
    surfaces = surfaces_of(RenderBuffers(buffer_of_halves(*halves), depth=depth))
    maker = PilotMaker(halves, surfaces, guides_of_colors(halves, surfaces, 1), 1)
    for image, noisy in zip(maker.images(Pilot("guided", 4, k=1.0)), halves, strict=True):
        assert image[:, 20].std() < 0.4 * noisy[:, 20].std()
        assert image[:, 20].mean() == pytest.approx(noisy[:, 20].mean(), rel=0.1)
        for column in (19, 21):  # neither dimmed nor lit by the other side
            assert np.abs(image[:, column] - noisy[:, column]).max() < 0.01


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


def test_windows_as_large_as_the_image_are_left_out() -> None:
    render = synthetic_render(height=32, width=48)
    result = denoise(render.buffers, short(preset="final", iterations=2))
    assert result.model is not None
    assert result.model.blend is not None
    assert result.model.blend.layout.pilots == BALANCED_PILOTS


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
        halves, surfaces = (color.half_a, color.half_b), surfaces_of(buffers)
        return PilotMaker(halves, surfaces, guides_of_colors(halves, surfaces, 1), 1).images(pilot)

    features = {name: noise(getattr(render.buffers, name)) for name in ("albedo", "normal", "depth")}
    noisy = render.buffers.with_quantities(**features)
    of_color, of_features = Pilot("color", 4, k=1.0), Pilot("guided", 4, k=1.0)
    alone = images(render.buffers.with_quantities(**dict.fromkeys(features)), of_color)
    np.testing.assert_array_equal(images(noisy, of_color), images(render.buffers, of_color))
    np.testing.assert_array_equal(images(noisy, of_color), alone)
    errors = [relmse(images(noisy, pilot)[0], render.reference) for pilot in (of_color, of_features)]
    assert errors[0] < 0.8 * errors[1]
