"""Blends of pilots: closer to the truth than their input, honest about their error, safe with any input."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from fitted_models import check_result, short
from synthetic import SyntheticRender, buffer_of_halves, relmse, synthetic_render
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.fit.preparation.exposure import exposure


def _halved(color: FloatImage, relative_noise: float, seed: int = 0) -> Buffer:
    """Independent halves of a noise-free colour."""
    rng = np.random.default_rng(seed)
    half_a, half_b = (
        (color * (1 + relative_noise * rng.standard_normal(color.shape))).astype(np.float32) for _ in range(2)
    )
    return Buffer((half_a + half_b) / 2, half_a, half_b)


@pytest.mark.parametrize(
    ("preset", "spp", "factor"),
    [("draft", 4, 20), ("draft", 16, 20), ("draft", 64, 12), ("balanced", 16, 25), ("final", 16, 25)],
)
def test_error_falls_and_is_estimated(preset: str, spp: int, factor: float) -> None:
    render = synthetic_render(spp=spp)
    result = denoise(render.buffers, short(preset=preset, iterations=60))
    check_result(result, render.buffers)
    error = relmse(result.color, render.reference)
    assert error < relmse(render.buffers.color.mean, render.reference) / factor
    assert result.estimated_relmse is not None
    # Some thousand pixels do not tell it well.
    assert error / 2 < result.estimated_relmse < 6 * error
    assert result.iterations == 60
    assert [point.iteration for point in result.history] == sorted(
        point.iteration for point in result.history
    )
    assert result.history[-1].iteration == 60


def test_mean_radiance_is_kept() -> None:
    render = synthetic_render(height=60, width=80, spp=16)
    result = denoise(render.buffers, short())
    assert result.color.mean() == pytest.approx(render.reference.mean(), rel=0.02)


def test_same_seed_same_bits_whatever_the_threads(render: SyntheticRender) -> None:
    first, again, other = (
        denoise(render.buffers, short(preset="balanced", seed=seed, threads=threads)).color
        for seed, threads in ((3, 1), (3, 2), (4, 2))
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@pytest.mark.parametrize("exponent", [-20, -3, 5, 30])
def test_exposure_changes_nothing_but_the_exposure(exponent: int, render: SyntheticRender) -> None:
    scale = np.float32(2.0**exponent)
    color = render.buffers.color
    assert color.half_a is not None
    assert color.half_b is not None
    assert color.variance is not None
    brighter = Buffer(
        color.mean * scale, color.half_a * scale, color.half_b * scale, color.variance * scale**2
    )
    # Albedos above 1 are emitted light, in the unit of the colour.
    albedo = render.buffers.albedo
    assert albedo is not None
    unlit = Buffer(**{name: np.minimum(image, 1) for name, image in albedo.planes()})
    plain = denoise(render.buffers.with_quantities(albedo=unlit), short())
    scaled = denoise(render.buffers.with_quantities(albedo=unlit, color=brighter), short())
    np.testing.assert_array_equal(scaled.color, plain.color * scale)
    assert scaled.estimated_relmse is not None
    assert plain.estimated_relmse is not None
    # The 0.01 of the relMSE is in the unit of the colour.
    assert (scaled.estimated_relmse > plain.estimated_relmse) == (exponent > 0)


@pytest.mark.parametrize("noise_of_sky", [0.0, 0.1])
@pytest.mark.parametrize("darker", [0.01, 0.001])
def test_what_a_bright_sky_outshines_is_denoised(noise_of_sky: float, darker: float) -> None:
    """It is most of the picture, and the foreground has next to nothing of its radiance."""
    sky = np.repeat((np.indices((50, 64))[0] < 30)[:, :, None], 3, axis=2)
    truth = np.where(sky, 1, darker).astype(np.float32)
    shape = np.where(sky, 1 / max(noise_of_sky, 1e-4) ** 2, 2)
    rng = np.random.default_rng(0)
    a, b = (np.float32(truth * rng.gamma(shape, 1 / shape)) for _ in range(2))
    depth = Buffer(np.where(sky[:, :, :1], 0, 3).astype(np.float32))
    result = denoise(RenderBuffers(buffer_of_halves(a, b), depth=depth), short())
    noisy, denoised = (np.mean((image / darker - 1)[~sky] ** 2) for image in ((a + b) / 2, result.color))
    assert denoised < 0.1 * noisy


def test_the_units_of_a_fit_do_not_hang_on_one_pixel(render: SyntheticRender) -> None:
    """Repaired or written by hand, it may have a mean that is not that of its halves."""
    color = render.buffers.color
    mean = color.mean.copy()
    mean[7, 9] = 1e-30
    assert exposure(replace(color, mean=mean)) == exposure(color)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("exponent", [-126, -80, 80, 98])
def test_any_exposure_is_denoised_without_overflow(exponent: int, render: SyntheticRender) -> None:
    color = render.buffers.color
    planes = {
        name: np.ldexp(plane, 2 * exponent if name == "variance" else exponent)
        for name, plane in color.planes()
        if name != "variance" or abs(exponent) < 60
    }
    # A variance that float32 can hold beside any colour.
    planes.setdefault("variance", np.full_like(color.mean, 1e-38 if exponent < 0 else 1e38))
    result = denoise(render.buffers.with_quantities(color=Buffer(**planes)), short(iterations=5))
    assert np.isfinite(result.color).all()
    kept, given = (image.mean(dtype=np.float64) for image in (result.color, planes["mean"]))
    assert kept == pytest.approx(given, rel=0.1)


@pytest.mark.parametrize("exponent", [-118, -130])
def test_images_near_the_smallest_numbers_are_denoised(exponent: int, render: SyntheticRender) -> None:
    dark = [np.ldexp(image, exponent) for image in (render.buffers.color.mean, *render.buffers.color.halves)]
    result = denoise(render.buffers.with_quantities(color=Buffer(*dark)), short())
    noisy, denoised = (
        np.mean((np.ldexp(image, -exponent) - render.reference) ** 2) for image in (dark[0], result.color)
    )
    assert denoised < 0.2 * noisy


def test_dark_images_are_not_taken_for_clean_ones(render: SyntheticRender) -> None:
    """Without halves to trust, the exposure changes nothing either."""
    color, scale = render.buffers.color, np.float32(2.0**-21)
    noise = (color.mean - render.reference) / 2
    a, b = color.mean + noise, color.mean + noise / 2
    images = [
        denoise(RenderBuffers(Buffer((a + b) / 2 * s, a * s, b * s)), short()).color for s in (1, scale)
    ]
    assert np.abs(images[0] / ((a + b) / 2) - 1).max() > 0.1
    np.testing.assert_array_equal(images[1], images[0] * scale)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (7, 5), (33, 17)])
@pytest.mark.parametrize("halves", [True, False])
def test_any_size(size: tuple[int, int], halves: bool) -> None:
    buffers = synthetic_render(*size).buffers
    if not halves:
        buffers = buffers.with_quantities(color=Buffer(buffers.color.mean))
    result = denoise(buffers, short(iterations=3))
    check_result(result, buffers)


def test_color_alone(render: SyntheticRender) -> None:
    buffers = RenderBuffers(render.buffers.color)
    result = denoise(buffers, short())
    check_result(result, buffers)
    assert any("no albedo, normal, depth" in note for note in result.notes)
    noisy = relmse(buffers.color.mean, render.reference)
    assert relmse(result.color, render.reference) < noisy / 1.4
    without_halves = RenderBuffers(Buffer(buffers.color.mean))
    result = denoise(without_halves, short())
    check_result(result, without_halves)
    assert relmse(result.color, render.reference) < 1.2 * noisy  # every edge passes for noise


def test_without_halves_the_noise_is_split(render: SyntheticRender) -> None:
    color = render.buffers.color
    buffers = render.buffers.with_quantities(color=Buffer(color.mean))
    result = denoise(buffers, short())
    check_result(result, buffers)
    assert result.model is not None
    assert any("no half buffers that can be used: its noise" in note for note in result.notes)
    error = relmse(result.color, render.reference)
    assert error < relmse(color.mean, render.reference) / 8
    assert result.estimated_relmse is not None
    assert error / 4 < result.estimated_relmse < 4 * error
    assert (denoise(buffers, short()).color == result.color).all()


def test_without_halves_fireflies_are_limited_and_lamps_are_not(render: SyntheticRender) -> None:
    color, albedo = render.buffers.color.mean.copy(), np.full_like(render.buffers.color.mean, 0.5)
    color[10, 10] = 1e4
    color[29:32, 29:32] = albedo[29:32, 29:32] = 1e3  # in plain view
    result = denoise(RenderBuffers(Buffer(color), albedo=Buffer(albedo)), short())
    assert any(" limited, with " in note for note in result.notes)
    assert result.color[8:13, 8:13].max() < 100
    assert result.color[27:34, 27:34].sum() > 0.5 * color[29:32, 29:32].sum()


def test_a_firefly_leaves_no_blot(render: SyntheticRender) -> None:
    color = render.buffers.color
    assert color.half_a is not None
    assert color.half_b is not None
    half_a = color.half_a.copy()
    half_a[8, 9] = 1e7
    buffers = render.buffers.with_quantities(color=Buffer((half_a + color.half_b) / 2, half_a, color.half_b))
    result = denoise(buffers, short())
    check_result(result, buffers)
    assert any("1 firefly limited" in note for note in result.notes)
    assert relmse(result.color, render.reference) < relmse(color.mean, render.reference) / 4


def test_black_stays_black(render: SyntheticRender) -> None:
    black = np.zeros((12, 17, 3), np.float32)
    for color in (Buffer(black, black, black, black), Buffer(black)):
        buffers = RenderBuffers(color)
        result = denoise(buffers, short(iterations=3))
        check_result(result, buffers)
        np.testing.assert_array_equal(result.color, black)


@pytest.mark.parametrize("relative_noise", [1e-4, 1e-3])
def test_a_converged_image_is_left_nearly_alone(relative_noise: float, render: SyntheticRender) -> None:
    # Shadows that no feature shows: any filter alone would blur them.
    color = render.reference * (1 + 0.5 * np.sin(np.arange(56) * 0.9))[None, :, None]
    buffers = render.buffers.with_quantities(color=_halved(color.astype(np.float32), relative_noise))
    result = denoise(buffers, short())
    check_result(result, buffers)
    np.testing.assert_allclose(result.color, buffers.color.mean, rtol=1e-3)


def test_the_halves_of_the_result_are_what_its_mean_is_made_of(render: SyntheticRender) -> None:
    result = denoise(render.buffers, short())
    assert result.halves is not None
    np.testing.assert_allclose((result.halves[0] + result.halves[1]) / 2, result.color, rtol=1e-6, atol=1e-7)
    assert (result.halves[0] != result.halves[1]).any()


def test_strands_before_nothing_are_found_by_alpha() -> None:
    """Without features, all that tells thin strands from noise is their coverage."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[0:72, 0:112].astype(np.float32)
    alpha = np.zeros((72, 112, 1), np.float32)
    for strand in range(24):
        at = rng.uniform(-20, 132) + rng.uniform(-0.5, 0.5) * rows + 4 * np.sin(rows / 12 + strand)
        alpha[..., 0] = np.maximum(alpha[..., 0], np.clip(1.2 - np.abs(columns - at), 0, 1))
    truth = alpha * np.array([0.6, 0.4, 0.25], np.float32)
    noisy = Buffer((truth * rng.gamma(10, 0.1, alpha.shape)).astype(np.float32))
    draft = FitSettings(preset="draft")
    result = denoise(RenderBuffers(noisy, alpha=alpha), draft)
    assert relmse(result.color, truth) < 0.7 * relmse(noisy.mean, truth)
    assert 0.93 < result.color.mean() / truth.mean() < 1.07
    assert any("alpha takes the albedo's place" in note for note in result.notes)
    assert result.model is not None
    assert result.model.inputs[0] == "alpha.A"
    hidden = denoise(RenderBuffers(noisy, alpha=np.ones_like(alpha)), draft)
    assert not any("alpha" in note for note in hidden.notes)


def test_progress_never_falls_and_ends_at_one(render: SyntheticRender, oidn_images: list[FloatImage]) -> None:
    oidn_images[:] = render.reference, render.reference
    without_halves = RenderBuffers(Buffer(render.buffers.color.mean))
    for buffers, changes in (
        (render.buffers, {}),
        (render.buffers, {"target_error": 10.0}),
        (render.buffers, {"pilot": "oidn"}),
        (without_halves, {}),
    ):
        told: list[float] = []
        denoise(buffers, short(**changes), lambda fraction, _, told=told: told.append(fraction))
        assert told == sorted(told)
        assert told[-1] == 1


def test_inputs_stay_as_they_are(render: SyntheticRender) -> None:
    before = {
        (name, plane): array.tobytes()
        for name, buffer in render.buffers.quantities()
        for plane, array in buffer.planes()
    }
    denoise(render.buffers, short(iterations=2))
    for name, buffer in render.buffers.quantities():
        for plane, array in buffer.planes():
            assert array.tobytes() == before[name, plane]


@pytest.mark.parametrize("preset", ["draft", "paper"])
def test_no_light_where_nothing_is_covered(
    preset: Literal["draft", "paper"], render: SyntheticRender
) -> None:
    """Features are left out: alpha alone tells that there is nothing."""
    color = render.buffers.color
    rows, columns = np.indices(color.mean.shape[:2])
    covered = (rows - 20) ** 2 + (columns - 20) ** 2 < 150
    glow = (rows > 40) & (columns > 40)
    alpha = covered[:, :, None].astype(np.float32)
    light = (covered | glow)[:, :, None]
    planes = {name: np.where(light, plane, np.float32(0)) for name, plane in color.planes()}
    buffers = RenderBuffers(Buffer(**planes), alpha=alpha)
    settings = short() if preset == "draft" else FitSettings("paper", iterations=2, inputs="random")
    result = denoise(buffers, settings)
    for image in (result.color, *(result.halves or ())):
        assert (image[~(covered | glow)] == 0).all()
        assert (image[glow] > 0).all()


@pytest.mark.parametrize("preset", ["draft", "paper"])
def test_an_alpha_that_is_not_finite_is_repaired_and_told(
    preset: Literal["draft", "paper"], render: SyntheticRender
) -> None:
    color = render.buffers.color
    alpha = np.ones((*color.mean.shape[:2], 1), np.float32)
    alpha[:20], alpha[3, 3], alpha[4:6, 4], alpha[8, 8] = 0, np.nan, np.inf, -np.inf
    settings = short() if preset == "draft" else FitSettings("paper", iterations=2, inputs="random")
    result = denoise(RenderBuffers(color, alpha=alpha), settings)
    assert np.isfinite(result.color).all()
    assert [note for note in result.notes if note.startswith("repaired")] == [
        "repaired alpha 1 NaN, 3 infinite"
    ]


def test_halves_of_an_image_without_noise_are_copies(render: SyntheticRender) -> None:
    truth = render.reference
    half_a, half_b = truth, truth * np.float32(1.001)
    result = denoise(RenderBuffers(Buffer((half_a + half_b) / 2, half_a, half_b)), short())
    assert result.model is None
    assert result.halves is not None
    for half, given in zip(result.halves, (half_a, half_b), strict=True):
        np.testing.assert_array_equal(half, given)
        assert not np.shares_memory(half, given)


def test_small_images_are_no_worse_for_more_pilots() -> None:
    errors = []
    for preset in ("draft", "balanced"):
        renders = [synthetic_render(64, 36, seed=seed) for seed in range(3)]
        results = [denoise(r.buffers, FitSettings(preset, threads=1)).color for r in renders]
        errors.append(np.mean([relmse(c, r.reference) for c, r in zip(results, renders, strict=True)]))
    assert errors[1] < 1.1 * errors[0]
