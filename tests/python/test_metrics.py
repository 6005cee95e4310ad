import numpy as np
import pytest

from synthetic import synthetic_render
from tungsten_dip.buffers.display import ldr_from_radiance
from tungsten_dip.buffers.relmse import relative_squared_error
from tungsten_dip.errors import InputError
from tungsten_dip.report.metrics import compare


@pytest.fixture
def gradient():
    rows, columns = np.mgrid[0:13, 0:17].astype(np.float32)
    return np.stack([rows / 13, columns / 17, np.full_like(rows, 0.25)], axis=-1)


def test_psnr_and_relmse_of_a_known_offset(gradient):
    reference = np.full((9, 5, 3), 0.5, dtype=np.float32)
    image = reference + np.float32(0.1)
    result = compare(image, reference)
    assert result.relmse == pytest.approx(0.1**2 / (0.5**2 + 0.01), rel=1e-5)
    assert result.psnr == pytest.approx(-20 * np.log10(0.6 ** (1 / 2.2) - 0.5 ** (1 / 2.2)), rel=1e-5)
    assert result.mean_ratio == pytest.approx(1.2, rel=1e-6)


def test_an_image_equals_itself(gradient):
    result = compare(gradient, gradient)
    assert (result.psnr, result.relmse, result.flip, result.hdrflip) == (np.inf, 0, 0, 0)
    assert result.ssim == pytest.approx(1)
    assert result.mean_ratio == 1


def test_every_measure_worsens_with_noise(render):
    little = compare(synthetic_render(spp=256).buffers.color.mean, render.reference)
    much = compare(render.buffers.color.mean, render.reference)
    assert little.psnr > much.psnr
    assert little.ssim > much.ssim
    for name in ("relmse", "flip", "hdrflip"):
        assert 0 < getattr(little, name) < getattr(much, name)


def test_relmse_sees_what_the_display_clips():
    reference = np.full((8, 8, 3), 10, dtype=np.float32)
    result = compare(reference * 2, reference)
    assert result.psnr == np.inf
    assert result.relmse == pytest.approx(100 / 100.01, rel=1e-5)


def test_values_that_are_not_finite_are_counted_and_taken_as_black(gradient):
    broken = gradient.copy()
    broken[0, 0] = (np.nan, np.inf, -np.inf)
    black = gradient.copy()
    black[0, 0] = 0
    result = compare(broken, gradient)
    assert result.nonfinite == 3
    assert result.relmse == compare(black, gradient).relmse


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (6, 40)])
@pytest.mark.parametrize("level", [0.0, 0.5, 20.0])
def test_small_and_uniform_images_have_what_can_be_measured(height, width, level):
    reference = np.full((height, width, 3), level, dtype=np.float32)
    result = compare(reference + np.float32(0.25), reference)
    assert result.relmse == pytest.approx(0.25**2 / (level**2 + 0.01), rel=1e-4)
    assert result.ssim is None
    assert result.hdrflip is None
    assert (result.mean_ratio is None) == (level == 0)


@pytest.mark.parametrize(
    ("image_shape", "reference_shape", "message"),
    [
        ((4, 5, 3), (5, 4, 3), "one shape"),
        ((4, 5, 1), (4, 5, 1), "one shape"),
        ((4, 5), (4, 5), "one shape"),
        ((0, 5, 3), (0, 5, 3), "with pixels"),
    ],
)
def test_shapes_that_cannot_be_compared(image_shape, reference_shape, message):
    with pytest.raises(InputError, match=message):
        compare(np.zeros(image_shape, np.float32), np.zeros(reference_shape, np.float32))


def test_a_broken_reference_is_refused(gradient):
    broken = gradient.copy()
    broken[2, 3, 1] = np.nan
    with pytest.raises(InputError, match="finite reference"):
        compare(gradient, broken)


def test_relative_squared_error_keeps_the_shape():
    image, reference = np.ones((2, 3, 3), np.float32), np.zeros((2, 3, 3), np.float32)
    np.testing.assert_allclose(relative_squared_error(image, reference), np.full((2, 3, 3), 100.0))


def test_display_clips_and_applies_the_gamma():
    image = np.array([[[-1.0, 0.5, 7.0]]], dtype=np.float32)
    np.testing.assert_allclose(ldr_from_radiance(image), [[[0, 0.5 ** (1 / 2.2), 1]]], rtol=1e-6)


@pytest.mark.parametrize(
    ("color", "reference"),
    [
        ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)),
        ((0.2, 0.5, 0.1), (0.25, 0.45, 0.1)),
        ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        ((0.9, 0.1, 0.3), (0.1, 0.4, 0.6)),
    ],
)
def test_flip_of_uniform_images_is_the_published_colour_difference(color, reference):
    # Filters leave uniform images as they are, and there are no edges or points in them.
    images = [np.full((40, 40, 3), each, dtype=np.float32) for each in (color, reference)]
    displayed = [ldr_from_radiance(image)[0, 0].astype(np.float64) for image in images]
    assert compare(*images).flip == pytest.approx(flip_of_colors(*displayed), abs=2e-3)


def flip_of_colors(displayed, displayed_reference):
    """Andersson et al., "FLIP: A Difference Evaluator for Alternating Images" (HPG 2020), section 4.1."""

    def hunt_lab(srgb):
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        to_xyz = np.array(
            [
                [0.4124564, 0.3575761, 0.1804375],
                [0.2126729, 0.7151522, 0.0721750],
                [0.0193339, 0.1191920, 0.9503041],
            ]
        )
        ratio = to_xyz @ linear / to_xyz.sum(axis=1)
        f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
        lightness = 116 * f[1] - 16
        # The Hunt effect: colours look less saturated where it is dark.
        return np.array(
            [lightness, *(np.array([500 * (f[0] - f[1]), 200 * (f[1] - f[2])]) * 0.01 * lightness)]
        )

    def hyab(a, b):
        return abs(a[0] - b[0]) + np.hypot(*(a - b)[1:])

    power, corner, level = 0.7, 0.4, 0.95
    largest = hyab(hunt_lab(np.array([0.0, 1.0, 0.0])), hunt_lab(np.array([0.0, 0.0, 1.0]))) ** power
    difference = hyab(hunt_lab(displayed), hunt_lab(displayed_reference)) ** power
    if difference < corner * largest:
        return level / (corner * largest) * difference
    return level + (difference - corner * largest) / ((1 - corner) * largest) * (1 - level)


def test_hdr_flip_sees_what_the_display_clips(gradient):
    reference = 20 * gradient
    brighter = np.where(reference > 1, 2 * reference, reference)
    result = compare(brighter, reference)
    assert result.flip == pytest.approx(0, abs=1e-6)
    assert result.hdrflip > 0.05


def test_ssim_of_uniform_images_compares_their_levels_alone():
    low, high = 0.2, 0.5
    images = [np.full((16, 16, 3), level**2.2, dtype=np.float32) for level in (low, high)]
    c1 = 0.01**2
    assert compare(*images).ssim == pytest.approx((2 * low * high + c1) / (low**2 + high**2 + c1), rel=1e-4)


@pytest.mark.parametrize("level", [1e-9, 1e-7, 1e-6, 1.0])
def test_dark_references_have_no_exposures_for_flip(level: float) -> None:
    reference = (level * np.random.default_rng(0).random((16, 16, 3))).astype(np.float32)
    hdrflip = compare(reference * np.float32(1.1), reference).hdrflip
    assert (hdrflip is None) == (level < 5e-7)


def test_values_beyond_float32_are_refused(gradient):
    large = np.full(gradient.shape, 1e300)
    for name, pair in (("image", (large, gradient)), ("reference", (gradient, large))):
        with pytest.raises(InputError, match=f"{name}: expected values up to 3e38"):
            compare(*pair)
