"""Half buffers that are those of another image, or of unequal size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fitted_models import DRAFT, check_result
from synthetic import SyntheticRender, synthetic_render
from tungsten_dip.buffers.half_buffers import without_foreign_halves
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.fit import denoise
from tungsten_dip.fit.preparation.prepare import prepare_input


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


@pytest.mark.parametrize(
    ("lost", "left", "skipped"),
    [
        (np.nan, "half_a", False),
        (np.inf, "half_b", False),
        (3e36, "half_b", False),
        (np.nan, "half_b", True),
        (np.nan, "mean", False),
    ],
)
def test_noise_that_one_image_alone_shows_is_not_taken_for_detail(
    lost: float, left: str, skipped: bool
) -> None:
    """``skipped``: the renderer left out of the mean what it could not compute."""
    render = synthetic_render(96, 96)
    block = np.s_[20:80, 20:80]
    planes = {name: plane.copy() for name, plane in render.buffers.color.planes()}
    for name, plane in planes.items():
        if name != left:
            plane[block] = lost / 2 if name == "mean" else lost
    if skipped:
        planes["mean"][block] = planes[left][block]
    buffers = render.buffers.with_quantities(color=Buffer(**planes))
    result = denoise(buffers, DRAFT)
    check_result(result, buffers)
    assert not result.halves_drawn
    assert any("lost in 3600 of 9216 pixels" in note for note in result.notes)

    def relmse(image: FloatImage) -> float:
        truth = render.reference[block]
        return float(np.mean((image[block] - truth) ** 2 / (truth**2 + 0.01)))

    error = relmse(result.color)
    assert error < 2.5 * relmse(denoise(render.buffers, DRAFT).color)
    assert result.error is not None
    assert result.error[block].mean() > error / 2


def test_lamps_beside_what_one_half_lost_stay_in_both_halves(render: SyntheticRender) -> None:
    color, albedo = render.buffers.color, render.buffers.albedo
    assert albedo is not None
    changed = {}
    for quantity, buffer in (("color", color), ("albedo", albedo)):
        planes = {name: plane.copy() for name, plane in buffer.planes()}
        for plane in planes.values():
            plane[4:12, 4:12] = 9
        changed[quantity] = Buffer(**planes)
    lamp = changed["color"]
    lamp.mean[20:30, 20:40] = lamp.half_a[20:30, 20:40] = np.nan
    prepared = prepare_input(render.buffers.with_quantities(**changed), 1).buffers
    assert prepared.color.halves is not None
    whole = np.ones(color.mean.shape[:2], bool)
    whole[20:30, 20:40] = False
    for half, before in zip(prepared.color.halves, changed["color"].halves, strict=True):
        np.testing.assert_array_equal(half[whole], before[whole])
    np.testing.assert_allclose(sum(prepared.color.halves)[~whole] / 2, lamp.half_b[~whole], rtol=1e-5)


def test_an_image_of_one_half_alone_is_one_without_halves(render: SyntheticRender) -> None:
    color = render.buffers.color
    assert color.half_b is not None
    nothing = np.full_like(color.mean, np.nan)
    alone = render.buffers.with_quantities(color=Buffer(nothing, nothing, color.half_b, nothing))
    result = denoise(alone, DRAFT)
    check_result(result, alone)
    assert "half buffers are lost in every pixel" in result.notes
    assert result.halves_drawn
    single = render.buffers.with_quantities(color=Buffer(np.maximum(color.half_b, 0)))
    np.testing.assert_array_equal(result.color, denoise(single, DRAFT).color)


@pytest.mark.parametrize("variance", [False, True])
def test_halves_that_are_both_lost_do_not_agree(variance: bool, render: SyntheticRender) -> None:
    nothing = np.full_like(render.buffers.color.mean, np.nan)
    color = Buffer(nothing, nothing, nothing, nothing if variance else None)
    result = denoise(render.buffers.with_quantities(color=color), DRAFT)
    assert result.notes[-1] == "no pixel has any light: the image is returned as it is"
    assert result.notes[0].startswith("repaired color")


def test_a_black_image_without_halves_is_returned_as_it_is() -> None:
    result = denoise(RenderBuffers(Buffer(np.zeros((12, 17, 3), np.float32))), DRAFT)
    assert result.notes[-1] == "no pixel has any light: the image is returned as it is"
    assert not result.halves_drawn
    assert not result.color.any()


@pytest.mark.parametrize("missing", ["half_a", "half_b"])
@pytest.mark.parametrize("quantity", ["color", "albedo"])
def test_a_half_whose_other_half_is_missing_is_left_aside_with_a_note(
    missing: str, quantity: str, render: SyntheticRender
) -> None:
    buffer = getattr(render.buffers, quantity)
    single = render.buffers.with_quantities(**{quantity: replace(buffer, **{missing: None})})
    prepared = prepare_input(single, 1)
    letter = missing[-1].upper()
    assert any(
        f"{quantity}: half buffer" in note and f"{letter} is missing" in note for note in prepared.notes
    )
    left = getattr(prepared.buffers, quantity)
    assert left.half_a is None
    assert left.half_b is None
