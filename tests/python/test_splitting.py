"""Halves that are drawn from an image without any."""

from __future__ import annotations

import numpy as np

from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.fit.preparation.splitting import with_independent_halves


def _gamma_noise(shape: float) -> RenderBuffers:
    noisy = np.random.default_rng(3).gamma(shape, 1 / shape, (120, 160, 1)).astype(np.float32)
    return RenderBuffers(Buffer(np.ascontiguousarray(np.broadcast_to(noisy, (120, 160, 3)))))


def test_the_halves_of_gamma_noise_are_independent_and_as_noisy_as_real_ones() -> None:
    for shape in (1.0, 4.0, 30.0):
        buffers = _gamma_noise(shape)
        halved = with_independent_halves(buffers, 0, 1)
        assert halved.drawn
        assert "no half buffers" in halved.notes[0]
        assert halved.buffers.color.halves is not None
        a, b = (half[..., 0] - 1 for half in halved.buffers.color.halves)
        np.testing.assert_allclose((a + b) / 2, buffers.color.mean[..., 0] - 1, atol=1e-5)
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.1
        for half in (a, b):
            assert 0.8 < half.var() / (2 / shape) < 1.25


def test_other_seeds_and_images_are_split_otherwise() -> None:
    buffers = _gamma_noise(2.0)
    other = RenderBuffers(Buffer(np.ascontiguousarray(buffers.color.mean[::-1])))

    def share(image: RenderBuffers, seed: int) -> np.ndarray:
        half = with_independent_halves(image, seed, 1).buffers.color.half_a
        assert half is not None
        return half / image.color.mean

    np.testing.assert_array_equal(share(buffers, 0), share(buffers, 0))
    assert (share(buffers, 0) != share(buffers, 1)).mean() > 0.9
    assert (share(buffers, 0) != share(other, 0)).mean() > 0.9


def test_one_half_alone_has_a_firefly() -> None:
    """Whatever the seed: in both halves it would pass for detail."""
    color = np.random.default_rng(6).gamma(4, 0.25, (24, 32, 3)).astype(np.float32)
    for value in (1e3, 1e6, 1e12, 1e30):
        for place in ((10, 12), (0, 12), (0, 0)):
            color[place] = value
        for seed in range(30):
            halves = with_independent_halves(RenderBuffers(Buffer(color)), seed, 1).buffers.color.halves
            assert halves is not None
            for place in ((10, 12), (0, 12), (0, 0)):
                pixels = sorted(half[place].tolist() for half in halves)
                assert pixels == [[0] * 3, [np.float32(2 * value)] * 3]


def test_what_has_no_noise_is_not_torn_apart() -> None:
    flat = RenderBuffers(Buffer(np.full((20, 30, 3), 0.7, np.float32)))
    halves = with_independent_halves(flat, 0, 1).buffers.color.halves
    assert halves is not None
    for half in halves:
        np.testing.assert_allclose(half, 0.7, rtol=1e-3)


def test_emitted_light_is_split_as_the_colour_is() -> None:
    color = np.random.default_rng(5).gamma(2, 0.5, (40, 40, 3)).astype(np.float32)
    albedo = np.full_like(color, 0.5)
    color[10:20, 10:20] = albedo[10:20, 10:20] = 9
    split = with_independent_halves(RenderBuffers(Buffer(color), Buffer(albedo)), 0, 1).buffers
    assert split.color.halves is not None
    assert split.albedo is not None
    assert split.albedo.halves is not None
    for light, emitted in zip(split.color.halves, split.albedo.halves, strict=True):
        np.testing.assert_allclose((emitted - 1)[10:20, 10:20] / 8, light[10:20, 10:20] / 9, rtol=1e-5)
        np.testing.assert_array_equal(emitted[25:], albedo[25:])


def test_noise_of_each_channel_is_split_as_it_is_correlated() -> None:
    rng = np.random.default_rng(7)
    color = np.array([0.2, 0.5, 0.9], np.float32)
    for independent in (True, False):
        noise = rng.gamma(4, 1 / 4, (90, 120, 3 if independent else 1))
        noisy = RenderBuffers(Buffer((color * noise).astype(np.float32)))
        split = with_independent_halves(noisy, 0, 2).buffers
        assert split.color.halves is not None
        a, b = (half / color - 1 for half in split.color.halves)
        for first in range(3):
            # No noise is left in both halves: neither of a channel nor of the difference of two.
            assert abs(np.corrcoef(a[..., first].ravel(), b[..., first].ravel())[0, 1]) < 0.15
            second = (first + 1) % 3
            hue_a, hue_b = (half[..., first] - half[..., second] for half in (a, b))
            if independent:
                assert abs(np.corrcoef(hue_a.ravel(), hue_b.ravel())[0, 1]) < 0.15
            else:
                # There is hardly a difference.
                assert max(hue_a.std(), hue_b.std()) < 0.3 * a.std()


def test_lamps_in_plain_view_are_in_both_halves_and_stray_light_is_not() -> None:
    """The rims of lamps differ from their surroundings as single bright samples do."""
    emitted = np.zeros((96, 96), np.float32)
    emitted[4::12, 4::12] = emitted[4::12, 5::12] = emitted[5::12, 4::12] = emitted[5::12, 5::12] = 100
    lamps = emitted > 0
    emitted[10::12, 10::12], emitted[10::12, 11::12] = 100, 1
    stray = (emitted == 100) & ~lamps
    color, albedo = ((emitted + base)[:, :, None].repeat(3, axis=2) for base in (0.2, 0.5))
    albedo[emitted > 0] += 0.5
    split = with_independent_halves(RenderBuffers(Buffer(color), Buffer(albedo)), 0, 1).buffers
    assert split.color.half_a is not None
    share = (split.color.half_a / (2 * color)).mean(axis=2)
    torn = (share < 0.1) | (share > 0.9)
    assert torn[lamps].mean() < 0.02
    assert torn[stray].mean() > 0.5


def test_the_halves_of_a_lamps_rim_are_nearly_independent() -> None:
    """A half that misses the lamp tells little of whether the other half hits it."""
    random = np.random.default_rng(2)
    emitted = np.zeros((40, 400), np.float32)
    emitted[5:12] = 100
    emitted[12] = 100 * random.binomial(4, 0.25, 400) / 4
    color, albedo = ((emitted + base)[:, :, None].repeat(3, axis=2) for base in (0.2, 0.5))
    albedo[emitted > 0] += 0.5
    split = with_independent_halves(RenderBuffers(Buffer(color), Buffer(albedo)), 0, 1).buffers
    assert split.color.halves is not None
    a, b = (half[12, :, 0] for half in split.color.halves)
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.4
