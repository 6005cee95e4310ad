"""Half buffers that are those of another image, or of unequal size."""

from __future__ import annotations

import numpy as np
import pytest

from conftest import SyntheticRender
from fitted_models import DRAFT, check_result
from tungsten_dip.buffers.half_buffers import without_foreign_halves
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.fit import denoise


@pytest.mark.parametrize("spoil", ["sums", "another picture", "little of another layer"])
@pytest.mark.parametrize("black", [0.0, 0.8])
def test_halves_of_another_picture_are_left_aside(spoil: str, black: float, render: SyntheticRender) -> None:
    color = render.buffers.color
    assert color.half_a is not None
    assert color.half_b is not None
    mean, a, b = color.mean.copy(), color.half_a.copy(), color.half_b.copy()
    for image in (mean, a, b):
        image[: round(black * len(image))] = 0
    if spoil == "sums":
        a, b = a / 2, b / 2
    elif spoil == "another picture":
        a, b = (np.ascontiguousarray(half[:, ::-1]) for half in (a, b))
    else:
        mean[:, : mean.shape[1] // 8] = 0
    buffers = render.buffers.with_quantities(color=Buffer(mean, a, b, color.variance))
    result = denoise(buffers, DRAFT)
    check_result(result, buffers)
    assert any("color: the half buffers are not used" in note for note in result.notes)
    assert result.color.mean() == pytest.approx(mean.mean(), rel=0.05)


def test_halves_of_another_picture_are_found_wherever_they_show() -> None:
    """In a picture of many pixels, of which only some are looked at: not a single column, say."""
    a, b, mean = (np.zeros((1 << 14, 8, 3), np.float32) for _ in range(3))
    mean[:, 5:] = 1
    _, lines = without_foreign_halves(RenderBuffers(Buffer(mean, a, b)))
    assert len(lines) == 1
    assert without_foreign_halves(RenderBuffers(Buffer(mean, mean, mean)))[1] == ()


def test_halves_of_few_samples_belong_to_the_image() -> None:
    """As Tungsten saves them of 1 to 3 samples, which go to half A and B in turn."""
    random = np.random.default_rng(0)
    counts = random.integers(1, 4, (16, 24, 1))
    x, y, z = random.random((3, 16, 24, 3), np.float32)
    a = np.where(counts == 3, (x + z) / 2, x)
    b = np.where(counts == 1, np.float32(0), y)
    mean = (x + np.where(counts > 1, y, 0) + np.where(counts > 2, z, 0)) / counts.astype(np.float32)
    albedo = Buffer(mean, a, b)
    kept, lines = without_foreign_halves(RenderBuffers(albedo, albedo))
    assert lines == ()
    assert kept.albedo is albedo
    # Lights of their own, which sum up to the image.
    for lit in (0.02, 0.3, 0.6):
        b = np.where(random.random((16, 24, 1)) < lit, x, np.float32(0))
        assert without_foreign_halves(RenderBuffers(Buffer(a + b, a, b)))[1]


def test_halves_that_no_fit_uses_are_not_checked() -> None:
    depth = np.ones((4, 6, 1), np.float32)
    color = Buffer(np.ones((4, 6, 3), np.float32))
    assert without_foreign_halves(RenderBuffers(color, visibility=Buffer(depth, 0 * depth, depth)))[1] == ()


def test_halves_of_another_feature_are_left_aside(render: SyntheticRender) -> None:
    normal = render.buffers.normal
    assert normal is not None
    assert normal.halves is not None
    flipped = (np.ascontiguousarray(half[:, ::-1]) for half in normal.halves)
    mixed = render.buffers.with_quantities(normal=Buffer(normal.mean, *flipped, normal.variance))
    alone = render.buffers.with_quantities(normal=Buffer(normal.mean, variance=normal.variance))
    result = denoise(mixed, DRAFT)
    assert any("normal: the half buffers are not used" in note for note in result.notes)
    np.testing.assert_array_equal(result.color, denoise(alone, DRAFT).color)


def test_halves_of_unequal_size_are_used(render: SyntheticRender) -> None:
    color = render.buffers.color
    assert color.half_a is not None
    assert color.half_b is not None
    mean = (2 * color.half_a + color.half_b) / 3
    buffers = render.buffers.with_quantities(color=Buffer(mean, color.half_a, color.half_b))
    assert not denoise(buffers, DRAFT).halves_drawn
