import numpy as np
import pytest

from tungsten_dip.errors import InputError
from tungsten_dip.report.metrics import compare, display_from_linear, relative_squared_error


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


def test_every_measure_worsens_with_noise(render, make_render):
    little = compare(make_render(spp=256).buffers.color.mean, render.reference)
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
    np.testing.assert_allclose(display_from_linear(image), [[[0, 0.5 ** (1 / 2.2), 1]]], rtol=1e-6)
