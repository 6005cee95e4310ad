"""Texture that pre-filtering takes from an albedo: what comes back, and what does not."""

from __future__ import annotations

import numpy as np

from synthetic import buffer_of_halves, rgb_from_plane
from tungsten_dip.buffers.prefilter import prefilter_features
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.fit.pilots.texture import with_texture

_HEIGHT, _WIDTH = 61, 48


def _noisy(truth: np.ndarray, deviation: float) -> Buffer:
    """Return halves of a plane, with noise that is independent in every pixel and half."""
    rng = np.random.default_rng(0)
    return buffer_of_halves(
        *(rgb_from_plane(truth + deviation * rng.standard_normal(truth.shape)) for _ in range(2))
    )


def _filtered(albedo: Buffer) -> Buffer:
    filtered = prefilter_features(RenderBuffers(albedo, albedo=albedo), 1).albedo
    assert filtered is not None
    return filtered


def _error(image: FloatImage, truth: np.ndarray) -> float:
    return float(((image - truth[:, :, None]) ** 2).mean())


def test_a_pattern_as_fine_as_a_pixel_comes_back() -> None:
    truth = 0.5 + 0.08 * np.random.default_rng(1).choice((-1.0, 1.0), (_HEIGHT, _WIDTH))
    albedo = _noisy(truth, 0.1)
    filtered = _filtered(albedo)
    textured = with_texture(filtered, albedo, 1)
    for image, before, noisy in (
        (textured.mean, filtered.mean, albedo.mean),
        (textured.half_a, filtered.half_a, albedo.half_a),
        (textured.half_b, filtered.half_b, albedo.half_b),
    ):
        assert image is not None
        assert before is not None
        assert noisy is not None
        # By Wiener's formula the error of a known mean is signal * noise / (signal + noise).
        signal, noise = 0.08**2, _error(noisy, truth)
        assert _error(image, truth) < 1.25 * signal * noise / (signal + noise)
        assert _error(image, truth) < 0.75 * min(_error(before, truth), noise)


def test_noise_does_not() -> None:
    truth = np.full((_HEIGHT, _WIDTH), 0.5)
    albedo = _noisy(truth, 0.1)
    filtered = _filtered(albedo)
    given_back = with_texture(filtered, albedo, 1).mean - filtered.mean
    assert _error(given_back, np.zeros_like(truth)) < 0.01 * _error(albedo.mean, truth)


def test_beside_a_light_and_without_halves_there_is_none() -> None:
    truth = 0.5 + 0.08 * np.random.default_rng(1).choice((-1.0, 1.0), (_HEIGHT, _WIDTH))
    truth[30, 24] = 9
    albedo = _noisy(truth, 0.1)
    filtered = _filtered(albedo)
    textured = with_texture(filtered, albedo, 1)
    changed = np.abs(textured.mean - np.clip(filtered.mean, 0, 1)).max(axis=2)
    assert not changed[25:36, 19:30].any()
    assert (changed[:24] > 0).mean() > 0.9
    assert textured.mean.max() <= 1
    mean_alone = with_texture(Buffer(filtered.mean), Buffer(albedo.mean), 1)
    assert mean_alone.halves is None
    assert np.array_equal(mean_alone.mean, np.clip(filtered.mean, 0, 1))
