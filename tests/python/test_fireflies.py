"""Fireflies: what one half alone shows is limited, what both show and what is smooth is not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.fit.preparation import fireflies
from tungsten_dip.fit.preparation.fireflies import limit_fireflies
from tungsten_dip.sequence.following import Follower


def _halves(height: int = 24, width: int = 31) -> tuple[FloatImage, FloatImage]:
    """Two noisy halves of a smooth gradient of about radiance 1."""
    rng = np.random.default_rng(0)
    truth = np.linspace(0.5, 1.5, width)[None, :, None] * np.ones((height, width, 3))
    half_a, half_b = (truth * rng.gamma(4, 1 / 4, truth.shape) for _ in range(2))
    return half_a.astype(np.float32), half_b.astype(np.float32)


@pytest.mark.parametrize("half", [0, 1])
@pytest.mark.parametrize("radiance", [1e4, 1e6, 1e12, 1e20, 1e30])
@pytest.mark.parametrize("at", [(12, 15), (0, 0), (23, 30)])
def test_a_firefly_of_one_half_is_limited(half: int, radiance: float, at: tuple[int, int]) -> None:
    halves = _halves()
    halves[half][at] = radiance * np.array([1, 0.5, 0.25], np.float32)
    limited = limit_fireflies(*halves, 1)
    assert limited.note is not None
    assert limited.note.startswith("1 firefly limited")
    # 15 times what is around it, give or take the noise of that.
    level = limited.halves[half][at].mean()
    assert 5 < level < 30
    np.testing.assert_allclose(
        limited.halves[half][at] / limited.halves[half][at][0], [1, 0.5, 0.25], rtol=1e-5
    )
    others = np.ones(halves[0].shape[:2], bool)
    others[at] = False
    np.testing.assert_array_equal(limited.halves[half][others], halves[half][others])
    np.testing.assert_array_equal(limited.halves[1 - half], halves[1 - half])


def test_fireflies_side_by_side_do_not_support_one_another() -> None:
    halves = _halves()
    for at, radiance in (((10, 10), 1e5), ((10, 11), 1e8), ((11, 12), 1e20)):
        halves[0][at] = radiance
    limited = limit_fireflies(*halves, 2)
    assert limited.note is not None
    assert limited.halves[0].max() < 200


def test_sparse_light_on_black_is_the_image() -> None:
    rng = np.random.default_rng(7)
    halves = tuple((rng.random((54, 96, 1)) < 0.005).astype(np.float32).repeat(3, 2) for _ in range(2))
    limited = limit_fireflies(halves[0], halves[1], 1)
    assert limited.note is None
    np.testing.assert_array_equal(limited.halves, halves)
    struck = halves[0].copy()
    struck[20, 30] = 1e5
    assert limit_fireflies(struck, halves[1], 1).halves[0].max() == pytest.approx(15)
    mean = (halves[0] + halves[1]) / 2
    result = denoise(RenderBuffers(Buffer(mean, *halves)), FitSettings("draft", iterations=5))
    assert result.color.mean() > 0.5 * mean.mean()


@pytest.mark.parametrize("radiance", [1e3, 1e8, 1e30])
def test_a_light_that_both_halves_show_is_left_alone(radiance: float) -> None:
    halves = _halves()
    halves[0][5, 6], halves[1][5, 6] = radiance, 0.8 * radiance
    limited = limit_fireflies(*halves, 1)
    assert limited.note is None
    for before, after in zip(halves, limited.halves, strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("color", [(1e3, 1e3, 1e3), (3e3, 0, 0)])
@pytest.mark.parametrize("case", ["few samples", "many samples", "emission", "no variance"])
def test_both_halves_confirm_a_light_that_more_than_a_few_samples_or_the_albedo_show(
    case: str, color: tuple[float, float, float]
) -> None:
    halves = _halves()
    for half in halves:
        half[5, 6] = color
    # Two of sixteen samples found it, or four of them.
    relative = 0.5**0.5 if case in ("few samples", "emission") else 0.5
    deviation = None if case == "no variance" else np.float32(relative) * halves[0]
    lamp = np.zeros_like(halves[0])
    lamp[5, 6] = 900
    emission = (lamp, lamp) if case == "emission" else None
    limited = limit_fireflies(*halves, 1, emission, deviation)
    if case == "few samples":
        assert limited.note is not None
        assert limited.note.startswith("2 fireflies limited")
        assert all(half[5, 6].mean() < 30 for half in limited.halves)
    else:
        assert limited.note is None


@pytest.mark.parametrize("both", [True, False])
def test_light_that_few_samples_find_in_both_halves_is_kept(both: bool) -> None:
    rng = np.random.default_rng(5)
    halves = _halves(60, 90)
    for half in halves if both else halves[:1]:
        half[rng.random((60, 90)) < 0.05] = 1e3
    limited = limit_fireflies(*halves, 2)
    kept = sum(half.sum() for half in limited.halves) / sum(half.sum() for half in halves)
    if both:
        assert kept > 0.95
    else:
        assert kept < 0.9


@pytest.mark.parametrize("emits", [True, False])
def test_a_lamp_out_of_focus_supports_what_hit_it_and_nothing_else(emits: bool) -> None:
    halves = _halves(48, 48)
    emission = np.zeros_like(halves[0]), np.zeros_like(halves[1])
    for index, (row, column) in enumerate(((14, 14), (17, 25), (26, 13), (20, 20))):
        half = int(index == 3)
        halves[half][row, column] += 1e3
        if emits or half == 0:
            emission[half][row, column] = 1e3
    limited = limit_fireflies(*halves, 1, emission).halves
    assert (limited[1][20, 20].mean() > 999) == emits


@pytest.mark.parametrize(
    "spread",
    [np.ones((2, 2)), np.outer((1, 2, 1), (1, 2, 1)), np.outer((1, 23, 23, 1), (1, 23, 23, 1))],
    ids=["2x2", "tent", "cubic B-spline"],
)
def test_fireflies_that_a_pixel_filter_spread_do_not_support_those_of_the_other_half(
    spread: npt.NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    halves = _halves(48, 48)
    height, width = spread.shape
    for index, (top, left) in enumerate(((10, 10), (10, 16), (17, 9), (18, 17))):
        halves[index % 2][top : top + height, left : left + width] += (
            1e4 * spread[:, :, None] / spread.max()
        ).astype(np.float32)
    limited = limit_fireflies(*halves, 1).halves
    monkeypatch.setattr(fireflies, "_CROWD", 100)
    for half, alone in zip(limited, limit_fireflies(*halves, 1).halves, strict=True):
        np.testing.assert_array_equal(half, alone)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 5), (24, 31)])
def test_images_without_fireflies_keep_every_bit(size: tuple[int, int]) -> None:
    for halves in (_halves(*size), (np.zeros((*size, 3), np.float32),) * 2):
        limited = limit_fireflies(*halves, 1)
        assert limited.note is None
        for before, after in zip(halves, limited.halves, strict=True):
            assert before.tobytes() == after.tobytes()


def test_a_lone_pixel_is_bounded_by_the_other_half() -> None:
    dim, bright = np.full((1, 1, 3), 0.5, np.float32), np.full((1, 1, 3), 1e9, np.float32)
    limited = limit_fireflies(dim, bright, 1)
    assert limited.note is not None
    np.testing.assert_array_equal(limited.halves[0], dim)
    np.testing.assert_allclose(limited.halves[1], 2, rtol=1e-5)


def test_a_firefly_before_black_stays_finite() -> None:
    halves = np.zeros((9, 9, 3), np.float32), np.zeros((9, 9, 3), np.float32)
    halves[0][0] = halves[1][0] = 1
    halves[0][4, 4] = 1e30
    limited = limit_fireflies(*halves, 1).halves
    assert all(np.isfinite(half).all() for half in limited)
    assert limited[0].max() < 1e30
    assert limited[0].min() == 0
    # By itself it is the image.
    halves[0][0] = halves[1][0] = 0
    result = denoise(RenderBuffers(Buffer((halves[0] + halves[1]) / 2, *halves)), FitSettings("draft"))
    assert np.isfinite(result.color).all()
    assert result.color.max() > 0


def test_limits_scale_with_the_exposure() -> None:
    halves = _halves()
    halves[0][3, 4] = 1e7
    scaled = limit_fireflies(*(half * np.float32(2**-6) for half in halves), 1).halves
    for plain, small in zip(limit_fireflies(*halves, 1).halves, scaled, strict=True):
        np.testing.assert_array_equal(plain * np.float32(2**-6), small)


def test_removed_radiance_is_given_back_less_a_standard_error() -> None:
    rng = np.random.default_rng(1)
    halves = _halves(200, 300)
    struck = rng.random((200, 300)) < 0.004
    halves[0][struck] = 40
    limited = limit_fireflies(*halves, 2)
    assert limited.gain is not None
    given_back = (sum(limited.halves) / 2 * limited.gain).mean()
    removed = (sum(halves) - sum(limited.halves)).mean() / 2
    left = (sum(halves) / 2).mean() - given_back
    # Windows hold 20 to 90 fireflies: a standard error is 0.1 to 0.23 of their sum.
    assert 0.1 * removed < left < 0.23 * removed


@pytest.mark.parametrize("radiance", [1e2, 1e6, 1e30])
@pytest.mark.parametrize("side", [1, 3])
def test_a_single_firefly_gives_nothing_back(radiance: float, side: int) -> None:
    halves = _halves(60, 90)
    # A pixel filter may have spread it.
    halves[0][30 : 30 + side, 40 : 40 + side] = radiance
    limited = limit_fireflies(*halves, 1)
    assert limited.gain is not None
    assert limited.gain.max() == 1


def test_one_huge_firefly_among_many_does_not_brighten_the_image() -> None:
    rng = np.random.default_rng(1)
    gains = []
    for radiance in (40, 1e9):
        halves = _halves(200, 300)
        halves[0][rng.random((200, 300)) < 0.004] = 40
        halves[0][100, 150] = radiance
        gain = limit_fireflies(*halves, 2).gain
        assert gain is not None
        gains.append(gain.mean() - 1)
    assert gains[1] < 1.1 * gains[0]


def test_pixels_without_noise_gain_nothing() -> None:
    rng = np.random.default_rng(2)
    halves = _halves(120, 200)
    halves[0][:, 100:][rng.random((120, 100)) < 0.01] = 40
    for half in halves:
        half[:, :100] = 1
    gain = limit_fireflies(*halves, 2).gain
    assert gain is not None
    assert gain[:, :90].max() == 1
    assert gain[:, 120:].mean() > 1.03


def test_fireflies_of_a_lamp_give_nothing_back_elsewhere() -> None:
    rng = np.random.default_rng(4)
    lamps = np.zeros((200, 300), bool)
    rows, columns = np.indices(lamps.shape)
    lamps[(rows % 20 < 3) & (columns % 20 < 3)] = True
    gains = []
    for brightness in (1, 10):
        halves = _halves(200, 300)
        for half in halves:
            half[lamps] *= brightness
            half[lamps & (rng.random(lamps.shape) < 0.05)] = 200
        gain = limit_fireflies(*halves, 2).gain
        assert gain is not None
        gains.append(gain.mean() - 1)
    assert gains[0] > 0.01
    assert gains[1] < 0.05 * gains[0]


def test_a_highlight_does_not_get_back_most_of_what_others_have_lost() -> None:
    rng = np.random.default_rng(5)
    halves = _halves(120, 200)
    highlight = np.zeros((120, 200), bool)
    highlight[40:80, 80:120] = True
    halves[0][(rng.random((120, 200)) < 0.01) & ~highlight] = 40
    for half in halves:
        half[highlight] *= 100
    limited = limit_fireflies(*halves, 2)
    assert limited.gain is not None
    given_back = (sum(limited.halves) * (limited.gain - 1)).mean(axis=2)
    # In proportion to its noise the highlight would get nine tenths.
    assert 0 < given_back[highlight].sum() < 0.4 * given_back.sum()


def test_a_few_noisy_pixels_do_not_get_back_what_all_have_lost() -> None:
    rng = np.random.default_rng(2)
    half_a, half_b = (np.full((120, 200, 3), 0.5, np.float32) for _ in range(2))
    half_a[50:60, 90:100] *= rng.gamma(1, 1, (10, 10, 1))
    half_a[rng.random((120, 200)) < 0.05] = 400
    gain = limit_fireflies(half_a, half_b, 2).gain
    assert gain is not None
    assert 1.2 < gain.max() <= 1.5


def test_images_get_back_what_is_certain_and_frames_of_a_sequence_do_not() -> None:
    rng = np.random.default_rng(3)
    half_a, half_b = _halves(96, 128)
    half_a[rng.random((96, 128)) < 0.01] = 40
    buffers = RenderBuffers(Buffer((half_a + half_b) / 2, half_a, half_b))
    settings = FitSettings(preset="draft", iterations=5)
    image = denoise(buffers, settings)
    assert image.halves is not None
    assert image.gain is not None
    assert image.gain.mean() > 1.03
    plain = sum(image.halves) / 2
    np.testing.assert_allclose(image.color, plain * image.gain, rtol=1e-5)
    frame = Follower(settings).denoise(buffers).result
    assert frame.gain is None
    np.testing.assert_allclose(frame.color, plain, rtol=1e-5)
