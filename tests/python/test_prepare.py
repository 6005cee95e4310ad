"""What is repaired, replaced or left out of a fit's input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fitted_models import check_result, short
from synthetic import SyntheticRender, relmse, synthetic_render
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.errors import InputError
from tungsten_dip.fit import denoise
from tungsten_dip.fit.preparation.prepare import prepare_input


def test_an_empty_image_is_refused() -> None:
    color = Buffer(np.empty((0, 5, 3), np.float32))
    with pytest.raises(InputError, match="at least one pixel, got 5x0"):
        denoise(RenderBuffers(color), short())


@pytest.mark.parametrize("missing", ["albedo", "normal", "depth"])
def test_a_missing_feature_is_noted(missing: str, render: SyntheticRender) -> None:
    buffers = render.buffers.with_quantities(**{missing: None})
    result = denoise(buffers, short(iterations=5))
    check_result(result, buffers)
    assert any(note.startswith(f"no {missing}:") for note in result.notes)
    assert not any(note.startswith("no ") for note in denoise(render.buffers, short(iterations=1)).notes)


def test_copied_halves_are_replaced(render: SyntheticRender) -> None:
    mean = render.buffers.color.mean
    buffers = render.buffers.with_quantities(
        color=Buffer(mean, mean, mean.copy(), render.buffers.color.variance)
    )
    result = denoise(buffers, short())
    check_result(result, buffers)
    assert any("not independent" in note for note in result.notes)
    assert relmse(result.color, render.reference) < relmse(mean, render.reference) / 8


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 1e12, 1e30])
@pytest.mark.parametrize("halves", [True, False])
def test_what_no_renderer_can_mean_stays_out(value: float, halves: bool) -> None:
    buffers = synthetic_render(20, 24).buffers
    rng = np.random.default_rng(5)
    broken = {}
    for name, buffer in buffers.quantities():
        planes = {plane: array.copy() for plane, array in buffer.planes()}
        if name == "color" and not halves:
            planes = {"mean": planes["mean"], "variance": planes["variance"]}
        for array in planes.values():
            array[rng.integers(20, size=2), rng.integers(24, size=2)] = value
        broken[name] = Buffer(**planes)
    result = denoise(buffers.with_quantities(**broken), short(iterations=5))
    check_result(result, buffers)
    assert result.color.max() < 2 * denoise(buffers, short(iterations=5)).color.max()


@pytest.mark.parametrize("value", [1e12, 1e30, 3e38])
def test_a_wild_albedo_is_not_smeared(value: float, render: SyntheticRender) -> None:
    assert render.buffers.albedo is not None
    planes = {name: array.copy() for name, array in render.buffers.albedo.planes()}
    for name in ("mean", "half_a"):
        planes[name][30, 40] = value
    result = denoise(render.buffers.with_quantities(albedo=Buffer(**planes)), short())
    check_result(result, render.buffers)
    noisy = relmse(render.buffers.color.mean, render.reference)
    assert relmse(result.color, render.reference) < noisy / 4


def test_a_colour_without_a_sane_pixel_is_told(
    render: SyntheticRender, caplog: pytest.LogCaptureFixture
) -> None:
    color = render.buffers.color
    nothing = np.full_like(color.mean, np.nan)
    halves = render.buffers.with_quantities(color=replace(color, mean=nothing))
    assert denoise(halves, short()).color.mean() == pytest.approx(color.mean.mean(), rel=0.05)
    assert "in every pixel" not in caplog.text
    assert denoise(render.buffers.with_quantities(color=Buffer(nothing)), short()).color.mean() < 1e-3
    assert "in every pixel" in caplog.text


@pytest.mark.parametrize("scale", [2, 3.2, 100, 255])
@pytest.mark.parametrize("halves", [True, False])
def test_an_albedo_in_another_scale_is_left_out(
    scale: float, halves: bool, render: SyntheticRender, caplog: pytest.LogCaptureFixture
) -> None:
    planes = {name: plane for name, plane in render.buffers.albedo.planes() if halves or name == "mean"}
    scaled = Buffer(**{name: plane * np.float32(scale) for name, plane in planes.items()})
    result = denoise(render.buffers.with_quantities(albedo=scaled), short())
    [warning] = [record for record in caplog.records if record.levelname == "WARNING"]
    assert "expected 0 to 1" in warning.getMessage()
    without = denoise(render.buffers.with_quantities(albedo=None), short())
    np.testing.assert_array_equal(result.color, without.color)


@pytest.mark.parametrize("radiance", [1.5, 30.0])
def test_the_albedo_of_a_picture_full_of_light_is_used(
    radiance: float, render: SyntheticRender, caplog: pytest.LogCaptureFixture
) -> None:
    """A wide lamp or a bright sky: its albedo is its radiance, as is its colour."""
    buffers = {}
    lit = np.ones((40, 56, 1), bool)
    lit[10:20] = False
    for name in ("color", "albedo"):
        planes = getattr(render.buffers, name).planes()
        buffers[name] = Buffer(**{plane: np.where(lit, np.float32(radiance), x) for plane, x in planes})
    prepared = prepare_input(render.buffers.with_quantities(**buffers), 1)
    assert prepared.buffers.albedo is not None
    assert not caplog.text


@pytest.mark.parametrize(
    ("radiance", "albedo"),
    [
        pytest.param(0.45 * 5, 5.0, id="a lamp behind fog"),
        pytest.param(0.3, 1.08, id="an albedo of one noisy pixel"),
        pytest.param(np.nan, 5.0, id="a colour of NaN"),
    ],
)
def test_an_albedo_that_may_be_in_its_scale_is_used(
    radiance: float, albedo: float, caplog: pytest.LogCaptureFixture
) -> None:
    color, feature = (Buffer(np.full((1, 1, 3), value, np.float32)) for value in (radiance, albedo))
    assert prepare_input(RenderBuffers(color, feature), 1).buffers.albedo is not None
    assert "albedo" not in caplog.text


def test_gaps_between_samples_are_filled(render: SyntheticRender) -> None:
    """Every other pixel has no sample, and what a renderer leaves there is black."""
    spp = np.indices((40, 56, 1)).sum(axis=0).astype(np.float32) % 2 * 16
    planes = {
        name: Buffer(**{plane: image * (spp > 0) for plane, image in buffer.planes()})
        for name, buffer in render.buffers.quantities()
    }
    buffers = replace(render.buffers.with_quantities(**planes), spp=spp, alpha=(spp > 0).astype(np.float32))
    result = denoise(buffers, short())
    assert not result.halves_drawn
    assert [note for note in result.notes if "1120 of 2240 pixels have no sample" in note]
    assert result.color.mean() == pytest.approx(render.reference.mean(), rel=0.05)
    sampled = spp[..., 0] > 0
    error = relmse(result.color[sampled], render.reference[sampled])
    assert error < relmse(render.buffers.color.mean[sampled], render.reference[sampled]) / 3
    prepared = prepare_input(buffers, 1).buffers
    np.testing.assert_allclose(prepared.alpha, 1, rtol=1e-6)
    np.testing.assert_array_equal(prepared.color.mean[sampled], buffers.color.mean[sampled])
    assert (prepared.albedo.mean > 0).all()


@pytest.mark.parametrize("rows", [slice(0, 12), slice(10, 15), slice(0, 40)])
def test_areas_without_a_sample_stay_black(rows: slice, render: SyntheticRender) -> None:
    spp = np.full((40, 56, 1), 16, np.float32)
    spp[rows, :30] = 0
    planes = {
        name: Buffer(**{plane: image * (spp > 0) for plane, image in buffer.planes()})
        for name, buffer in render.buffers.quantities()
    }
    buffers = render.buffers.with_quantities(**planes)
    with_counts = prepare_input(replace(buffers, spp=spp), 1)
    assert not any("no sample" in note for note in with_counts.notes)
    np.testing.assert_array_equal(with_counts.buffers.color.mean, buffers.color.mean)
    spp[...] = 0
    assert prepare_input(replace(buffers, spp=spp), 1).notes == with_counts.notes


@pytest.mark.parametrize(("factor", "kept"), [(16, False), (1 / 16, False), (2, True), (1, True)])
def test_a_variance_that_the_halves_contradict_is_left_out(
    factor: float, kept: bool, render: SyntheticRender
) -> None:
    color = render.buffers.color
    changed = replace(color, variance=color.variance * np.float32(factor))
    prepared = prepare_input(render.buffers.with_quantities(color=changed), 1)
    assert (prepared.buffers.color.variance is not None) == kept
    told = [float(note.split(" got ")[1].split(" times")[0]) for note in prepared.notes if "variance" in note]
    assert told == ([] if kept else [pytest.approx(factor, rel=0.2)])
    # Copies show nothing of the noise, and without halves nothing does.
    for halves in ((color.mean, color.mean.copy()), (None, None)):
        alone = Buffer(color.mean, *halves, changed.variance)
        prepared = prepare_input(render.buffers.with_quantities(color=alone), 1)
        assert prepared.buffers.color.variance is not None
