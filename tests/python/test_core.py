"""The core through numpy: what it refuses, what it shares, never changes, finds and mends."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from synthetic import SyntheticRender, synthetic_render
from tungsten_dip import _core
from tungsten_dip.buffers.half_buffers import compare_halves
from tungsten_dip.buffers.prefilter import noise_in, prefilter_features
from tungsten_dip.buffers.render_buffers import (
    CHANNELS,
    FEATURES,
    TRAITS,
    Buffer,
    FloatImage,
    Quantity,
    RenderBuffers,
)
from tungsten_dip.buffers.sanitize import sanitize

SIZES = [(1, 1), (1, 9), (9, 1), (7, 5), (65, 67), (0, 4), (4, 0)]


def _frozen_bytes(buffers: RenderBuffers) -> list[bytes]:
    return [array.tobytes() for _, buffer in buffers.quantities() for _, array in buffer.planes()]


def _noisy_color(height: int, width: int, spp: int = 8, mirror: float = 0.0, seed: int = 0) -> RenderBuffers:
    """A flat grey whose samples alternate between A and B; ``mirror`` is minus the correlation of the two."""
    rng = np.random.default_rng(seed)
    a, fresh = rng.standard_normal((2, spp // 2, height, width, 3))
    b = -mirror * a + np.sqrt(1 - mirror**2) * fresh
    variance = np.concatenate([a, b]).var(axis=0, ddof=1) / spp
    half_a, half_b = (5 + half.mean(axis=0) for half in (a, b))
    planes = (array.astype(np.float32) for array in ((half_a + half_b) / 2, half_a, half_b, variance))
    return RenderBuffers(color=Buffer(*planes))


CALLS: list[Callable[[np.ndarray], object]] = [
    lambda array: _core.sanitize("color", array, None, None, None, 2),
    lambda array: _core.compare_halves(array, array, None, 2),
    lambda array: _core.prefilter_feature(array, array, array, None, radius=5, step=1, k=0.5, threads=2),
]


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.uint8, np.int32])
def test_other_dtypes_are_refused(call: Callable[[np.ndarray], object], dtype: type) -> None:
    with pytest.raises(
        TypeError, match=r"expected an aligned C-contiguous float32 array .* got .*of shape \(4, 5, 3\)"
    ):
        call(np.zeros((4, 5, 3), dtype))


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize(
    "array",
    [
        np.zeros((4, 5, 3), np.float32, order="F"),
        np.zeros((8, 5, 3), np.float32)[::2],
        np.zeros((4, 5), np.float32),
        np.zeros((1, 4, 5, 3), np.float32),
        np.frombuffer(bytes(4 * 60 + 1), np.float32, offset=1).reshape(4, 5, 3),  # not where floats may lie
    ],
)
def test_other_layouts_are_refused(call: Callable[[np.ndarray], object], array: FloatImage) -> None:
    with pytest.raises(ValueError, match="expected an aligned C-contiguous float32 array of shape"):
        call(array)


@pytest.mark.parametrize("call", CALLS)
def test_lists_are_refused(call: Callable[[np.ndarray], object]) -> None:
    with pytest.raises(TypeError):
        call([[[0.0]]])  # type: ignore[arg-type]


def test_shapes_must_agree() -> None:
    image, other = np.zeros((4, 5, 3), np.float32), np.zeros((5, 4, 3), np.float32)
    with pytest.raises(
        ValueError, match=r"^half_b: expected the shape of half_a, \(4, 5, 3\), got \(5, 4, 3\)$"
    ):
        _core.compare_halves(image, other, None, 2)
    with pytest.raises(ValueError, match="variance: expected the shape"):
        _core.compare_halves(image, image, other, 2)
    with pytest.raises(ValueError, match="half_a: expected the shape of mean"):
        _core.sanitize("color", image, other, None, None, 2)
    with pytest.raises(TypeError, match=r"^half_a: expected an aligned"):
        _core.compare_halves(image.astype(np.float64), image, None, 2)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=f"^quantity: expected one of {', '.join(TRAITS)}, got colour$"):
        _core.sanitize("colour", image, None, None, None, 2)


def test_the_gradient_of_a_norm_takes_images_of_one_shape_alone() -> None:
    x, three = np.zeros((2, 3), np.uint16), np.ones(3, np.float32)
    for y, gradient in ((x, x.T.copy()), (x.T.copy(), x), (x, x.ravel())):
        with pytest.raises(ValueError, match="in the shape of x"):
            _core.norm_act_gradient(gradient, x, three, three, 1e-5, 0.2, y, three, three)


@pytest.mark.parametrize("quantity", TRAITS)
def test_the_core_knows_every_quantity_and_which_may_be_negative(quantity: Quantity) -> None:
    image = np.full((2, 3, CHANNELS[quantity]), -1, np.float32)
    _, (found, *_) = _core.sanitize(quantity, image, None, None, None, 2)
    assert (found.negative == 0) == TRAITS[quantity].signed


def test_sane_buffers_are_shared(render: SyntheticRender) -> None:
    for _, buffer in render.buffers.quantities():
        for _, array in buffer.planes():
            if buffer is not render.buffers.normal:
                np.maximum(array, 0, out=array)
            array.flags.writeable = False
    mended, lines = sanitize(render.buffers, 2)
    assert lines == ()
    for (_, before), (_, after) in zip(render.buffers.quantities(), mended.quantities(), strict=True):
        for (_, old), (_, new) in zip(before.planes(), after.planes(), strict=True):
            assert new is old


def test_defects_are_mended_counted_and_not_in_place(render: SyntheticRender) -> None:
    buffers = render.buffers
    color, albedo = buffers.color, buffers.albedo
    assert color.half_a is not None
    assert color.half_b is not None
    assert albedo is not None
    assert albedo.variance is not None
    color.half_a[2, 3] = 7
    color.half_b[2, 3] = 3
    color.mean[2, 3] = np.nan
    color.mean[5, 5, 0] = -1
    color.mean[6, 6, 1] = 1e30
    albedo.variance[4:6] = np.inf
    before = _frozen_bytes(buffers)

    mended, lines = sanitize(buffers, 2)

    assert _frozen_bytes(buffers) == before
    color_line, albedo_line = (next(line for line in lines if name in line) for name in ("color", "albedo"))
    assert color_line == "repaired color 3 NaN, 1 negative"
    assert f"albedo variance {2 * buffers.width * 3} infinite" in albedo_line
    np.testing.assert_array_equal(mended.color.mean[2, 3], [5, 5, 5])
    assert mended.color.mean[5, 5, 0] == 0
    assert mended.color.mean[6, 6, 1] == np.float32(1e30)
    assert mended.color.half_a is color.half_a
    for _, buffer in mended.quantities():
        assert all(np.isfinite(array).all() for _, array in buffer.planes())
    assert sanitize(mended, 2)[1] == ()


def test_alpha_is_mended_where_it_is_not_finite_and_keeps_a_filters_lobes(render: SyntheticRender) -> None:
    alpha = np.ones((*render.reference.shape[:2], 1), np.float32)
    alpha[0, 0], alpha[0, 1] = -0.1, 1.2
    assert sanitize(replace(render.buffers, alpha=alpha), 2)[0].alpha is alpha
    damaged = alpha.copy()
    damaged[5, 5], damaged[9, 9], damaged[9, 10] = np.nan, np.inf, -np.inf
    before = damaged.tobytes()
    mended, lines = sanitize(replace(render.buffers, alpha=damaged), 2)
    assert mended.alpha is not None
    np.testing.assert_array_equal(mended.alpha, alpha)
    assert [line for line in lines if "alpha" in line] == ["repaired alpha 1 NaN, 2 infinite"]
    assert damaged.tobytes() == before


@pytest.mark.parametrize(
    ("plane", "told"), [("mean", "depth"), ("half_a", "depth half A"), ("half_b", "depth half B")]
)
def test_the_plane_that_was_mended_is_named(plane: str, told: str, render: SyntheticRender) -> None:
    depth = render.buffers.depth
    assert depth is not None
    planes = {name: np.maximum(array, 0) for name, array in depth.planes()}
    planes[plane][3, 4] = np.nan
    _, lines = sanitize(RenderBuffers(render.buffers.color, depth=Buffer(**planes)), 2)
    assert lines == (f"repaired {told} 1 NaN",)


@pytest.mark.parametrize("sky", [0, np.nan, np.inf, -np.inf, 1e10, -1e10])
def test_a_depth_that_is_negative_everywhere_changes_its_sign(sky: float, render: SyntheticRender) -> None:
    depth = render.buffers.depth
    assert depth is not None
    assert depth.halves is not None
    ahead = [np.where(depth.mean > 0.1, array, 0) for array in (depth.mean, *depth.halves)]
    behind = Buffer(*(np.where(array == 0, np.float32(sky), -array) for array in ahead), depth.variance)
    before = _frozen_bytes(buffers := render.buffers.with_quantities(depth=behind))
    mended, lines = sanitize(buffers, 2)
    assert lines[0] == "changed the sign of the depth, which was negative everywhere"
    assert len(lines) == (2 if sky else 1)
    expected, _ = sanitize(render.buffers.with_quantities(depth=Buffer(*ahead, depth.variance)), 2)
    assert mended.depth is not None
    assert expected.depth is not None
    if not np.isnan(sky):  # which is rebuilt from the depth around
        for (_, new), (_, true) in zip(mended.depth.planes(), expected.depth.planes(), strict=True):
            np.testing.assert_array_equal(new, true)
    assert _frozen_bytes(buffers) == before


def test_a_depth_of_both_signs_is_mended_where_it_is_negative() -> None:
    color = np.ones((2, 3, 3), np.float32)
    depth = np.array([[-1, -2, 0], [-3, np.nan, 4]], np.float32)[..., None]
    mended, lines = sanitize(RenderBuffers(Buffer(color), depth=Buffer(depth)), 2)
    assert lines == ("repaired depth 1 NaN, 3 negative",)
    assert mended.depth is not None
    assert (mended.depth.mean >= 0).all()


def test_what_negative_lobes_lack_comes_from_the_light_around(render: SyntheticRender) -> None:
    def sharpened(image: FloatImage) -> FloatImage:
        return np.asarray(1.4 * image - 0.2 * (np.roll(image, 1, axis=1) + np.roll(image, -1, axis=1)))

    planes = {
        name: plane if name == "variance" else sharpened(plane)
        for name, plane in render.buffers.color.planes()
    }
    buffers = render.buffers.with_quantities(color=Buffer(**planes))
    mended, _ = sanitize(buffers, 2)
    for name in ("mean", "half_a", "half_b"):
        before, after = getattr(buffers.color, name), getattr(mended.color, name)
        assert (before < 0).any()
        assert (after >= 0).all()
        assert after.mean() == pytest.approx(before.mean(), rel=1e-3)


def test_without_halves_the_neighbours_tell() -> None:
    mean = np.full((3, 3, 3), 2, np.float32)
    variance = np.full((3, 3, 3), 0.5, np.float32)
    mean[1, 1], variance[1, 1], variance[0, 0] = np.inf, np.nan, 0.75
    mended, lines = sanitize(RenderBuffers(color=Buffer(mean, variance=variance)), 2)
    assert lines == ("repaired color 3 infinite; color variance 3 NaN",)
    np.testing.assert_array_equal(mended.color.mean, 2)
    assert mended.color.variance is not None
    np.testing.assert_array_equal(mended.color.variance[1, 1], 0.75)


@pytest.mark.parametrize("shape", SIZES)
def test_every_size_passes_through_everything(shape: tuple[int, int]) -> None:
    color = _noisy_color(*shape).color
    normal = Buffer(color.mean - 5, color.half_a, color.half_b, color.variance)
    nowhere = Buffer(np.full((*shape, 1), np.nan, np.float32))
    buffers, lines = sanitize(RenderBuffers(color=color, normal=normal, depth=nowhere), 2)
    assert lines == ((f"repaired depth {shape[0] * shape[1]} NaN",) if shape[0] * shape[1] else ())
    assert buffers.depth is not None
    np.testing.assert_array_equal(buffers.depth.mean, np.zeros((*shape, 1)))
    filtered = prefilter_features(buffers, 2)
    assert filtered.normal is not None
    assert all(
        np.isfinite(array).all() and array.shape == (*shape, 3) for _, array in filtered.normal.planes()
    )
    assert filtered.depth is not None
    np.testing.assert_array_equal(filtered.depth.mean, buffers.depth.mean)
    assert filtered.depth.halves is None
    assert compare_halves(buffers, 2).independent == (shape == (65, 67))


def test_independence_is_told_from_mirrored_and_copied_halves() -> None:
    independent = compare_halves(_noisy_color(96, 80), 2)
    assert independent.independent
    assert abs(independent.correlation) < 0.1

    mirrored = compare_halves(_noisy_color(96, 80, mirror=0.5), 2)
    assert not mirrored.independent
    assert mirrored.correlation == pytest.approx(-0.5, abs=0.1)

    color = _noisy_color(96, 80).color
    copied = compare_halves(
        RenderBuffers(color=Buffer(color.mean, color.half_a, color.half_a, color.variance)), 2
    )
    assert (copied.independent, copied.correlation) == (False, 1.0)

    alone = compare_halves(RenderBuffers(color=Buffer(color.mean, variance=color.variance)), 2)
    assert not alone.independent
    assert np.isnan(alone.correlation)


def test_prefiltering_removes_noise_and_changes_nothing_else() -> None:
    noisy, truth = synthetic_render(seed=1).buffers, synthetic_render(spp=4, seed=2).buffers
    assert noisy.normal is not None
    assert truth.normal is not None
    clean = Buffer(truth.normal.mean, truth.normal.mean, truth.normal.mean, np.zeros_like(truth.normal.mean))
    buffers = noisy.with_quantities(normal=clean)
    before = _frozen_bytes(buffers)
    filtered = prefilter_features(buffers, 2)
    assert _frozen_bytes(buffers) == before
    assert filtered.color is buffers.color
    assert filtered.normal is not None
    np.testing.assert_array_equal(filtered.normal.mean, clean.mean)

    reference = np.mean([synthetic_render(seed=seed).buffers.albedo.mean for seed in range(10, 40)], axis=0)
    assert buffers.albedo is not None
    assert filtered.albedo is not None
    noise = np.mean((buffers.albedo.mean - reference) ** 2)
    # The floor's fine checkers have few equals to average with; on plain surfaces far less is left.
    assert np.mean((filtered.albedo.mean - reference) ** 2) < 0.6 * noise


def test_a_mean_below_its_halves_does_not_become_negative() -> None:
    """As where a negative mean was mended; but normals may be."""
    half = np.zeros((20, 24, 3), np.float32)
    half[10, 12] = 1
    feature = Buffer(0 * half, half, half, np.full_like(half, 0.25))
    filtered = prefilter_features(RenderBuffers(feature, albedo=feature, normal=feature), 2)
    assert filtered.albedo is not None
    assert filtered.normal is not None
    assert filtered.normal.mean[10, 12].max() < -0.5
    np.testing.assert_array_equal(filtered.albedo.mean[10, 12], 0)


def test_the_noise_of_an_image_is_told_from_its_slopes() -> None:
    rows, columns = np.indices((90, 120))
    noise = 0.3 * np.random.default_rng(7).standard_normal((90, 120))
    image = (2 * rows - columns + noise)[:, :, None].astype(np.float32)
    inner = noise_in(image, 1)[4:-4, 4:-4]
    assert inner.mean() == pytest.approx(0.3**2, rel=0.05)


def test_what_samples_of_two_kinds_leave_is_evened_out() -> None:
    """As in glass, where a sample is reflected or goes through: a single pass keeps a part of the speckle."""
    rng = np.random.default_rng(0)
    samples = (rng.uniform(size=(4, 64, 48, 3)) < 0.5).astype(np.float32)
    half_a, half_b = samples[::2].mean(axis=0), samples[1::2].mean(axis=0)
    albedo = Buffer((half_a + half_b) / 2, half_a, half_b, samples.var(axis=0, ddof=1) / 4)
    filtered = prefilter_features(RenderBuffers(albedo, albedo=albedo), 2).albedo
    assert filtered is not None
    one_pass = _core.prefilter_feature(
        albedo.mean, half_a, half_b, albedo.variance, radius=5, step=1, k=0.5, threads=2
    )[0]
    error, error_of_one = (float(np.mean((image - 0.5) ** 2)) for image in (filtered.mean, one_pass))
    assert error < 0.5 * error_of_one
    assert error_of_one < 0.1 * float(np.mean((albedo.mean - 0.5) ** 2))


def test_of_a_feature_without_halves_no_remaining_noise_is_claimed() -> None:
    noisy = np.random.default_rng(8).normal(0.5, 0.05, (30, 40, 3)).astype(np.float32)
    filtered = prefilter_features(RenderBuffers(Buffer(noisy), albedo=Buffer(noisy)), 2).albedo
    assert filtered is not None
    assert filtered.variance is None
    assert filtered.halves is None
    assert filtered.mean.std() < 0.7 * noisy.std()


def test_threads_do_not_change_a_bit() -> None:
    buffers = synthetic_render(height=71, width=133).buffers
    one, many = prefilter_features(buffers, threads=1), prefilter_features(buffers, threads=5)
    assert _frozen_bytes(one) == _frozen_bytes(many)
    assert compare_halves(buffers, 1).correlation == compare_halves(buffers, 5).correlation
    assert any(getattr(one, name) is not getattr(buffers, name) for name in FEATURES)


def test_sides_whose_sums_with_a_radius_may_overflow_are_refused() -> None:
    with pytest.raises(ValueError, match="up to 100000000 each"):
        _core.box_mean(np.empty((10**8 + 1, 0, 3), np.float32), 1, 2)


def test_without_threads_nothing_is_done() -> None:
    with pytest.raises(ValueError, match="threads: expected a whole number from 1 on, got 0"):
        _core.box_mean(np.ones((3, 3, 1), np.float32), 1, 0)


def _smoothed(
    image: FloatImage, features: FloatImage, along: float, across: float, threads: int = 2
) -> FloatImage:
    tensor = _core.structure_tensor(features, threads)
    return _core.smooth_along_edges(image, tensor, along=along, across=across, threads=threads)


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4, 2.5])
def test_the_structure_tensor_of_a_slope_is_the_product_of_its_gradients(angle: float) -> None:
    rows, columns = np.indices((41, 43), np.float32)
    slope = (2 * np.cos(angle) * columns + 2 * np.sin(angle) * rows)[:, :, None].astype(np.float32)
    tensor = _core.structure_tensor(np.concatenate((slope, slope), axis=2), 2)
    expected = 8 * np.array([np.cos(angle) ** 2, np.sin(angle) ** 2, np.cos(angle) * np.sin(angle)])
    inner = tensor[10:-10, 10:-10]
    # The derivative's kernel is cut off at 3 pixels.
    np.testing.assert_allclose(inner, np.broadcast_to(expected, inner.shape), atol=0.05)


def _smoothed_plainly(image: FloatImage, tensor: FloatImage, along: float, across: float) -> np.ndarray:
    """Return what `_core.smooth_along_edges` is to return, straight from its definition."""
    height, width = image.shape[:2]
    radius = int(np.ceil(2 * max(along, across)))

    def moved(planes: FloatImage, dy: int, dx: int) -> np.ndarray:
        padded = np.pad(planes.astype(np.float64), ((radius, radius), (radius, radius), (0, 0)), mode="edge")
        return padded[radius + dy : radius + dy + height, radius + dx : radius + dx + width]

    xx, yy, xy = moved(tensor, 0, 0).transpose(2, 0, 1)
    trace = np.maximum(xx + yy, 1e-12)
    coherence = np.hypot(xx - yy, 2 * xy) / trace
    sigma = np.maximum(along * coherence**2, across)
    angle = np.arctan2(2 * xy, xx - yy) / 2
    total, weights = np.zeros(image.shape), np.zeros((height, width, 1))
    for dy, dx in itertools.product(range(-radius, radius + 1), repeat=2):
        u, v = np.cos(angle) * dy - np.sin(angle) * dx, np.cos(angle) * dx + np.sin(angle) * dy
        apart = ((moved(tensor, dy, dx) - tensor) ** 2) @ (1, 1, 2)
        distance = u**2 / (2 * sigma**2) + v**2 / (2 * across**2) + 1.5 * apart / trace**2
        weight = np.exp(-distance)[:, :, None]
        total += weight * moved(image, dy, dx)
        weights += weight
    return total / weights


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (21, 70)])
@pytest.mark.parametrize("features", ["noise", "edges"])
def test_smoothing_along_edges_is_what_it_is_defined_as(size: tuple[int, int], features: str) -> None:
    rng = np.random.default_rng(3)
    image = rng.random((*size, 3), np.float32)
    # Where all edges of a block have one direction, most of its neighbours are left out.
    guide = rng.random((*size, 2), np.float32) if features == "noise" else 0 * image
    guide[:, 3::16] = 1
    tensor = _core.structure_tensor(guide, 2)
    smooth = _core.smooth_along_edges(image, tensor, along=3, across=0.5, threads=2)
    np.testing.assert_allclose(smooth, _smoothed_plainly(image, tensor, 3, 0.5), atol=2e-5)


def _half_plane(angle: float, size: int = 41) -> FloatImage:
    """Coverage of the pixels by the half-plane whose edge runs through the middle at an angle."""
    rows, columns = np.indices((size, size)) - size // 2
    distance = np.cos(angle) * columns + np.sin(angle) * rows
    return np.clip(distance + 0.5, 0, 1).astype(np.float32)[:, :, None]


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4, 1.2, np.pi / 2, 2.5])
def test_smoothing_along_edges_keeps_them_and_takes_their_noise(angle: float) -> None:
    edge = _half_plane(angle)
    noise = np.random.default_rng(4).normal(0, 0.1, edge.shape).astype(np.float32)
    smooth = _smoothed(edge, edge, along=3, across=0.3)
    inner = np.s_[8:-8, 8:-8]
    assert np.sqrt(np.mean((smooth - edge)[inner] ** 2)) < 0.03
    residual = _smoothed(edge + noise, edge, along=3, across=0.3) - smooth
    at_edge = (edge[inner] > 0.01) & (edge[inner] < 0.99)
    assert residual[inner][at_edge].std() < 0.06


def test_smoothing_along_edges_leaves_corners_and_constants() -> None:
    corner = np.zeros((31, 31, 3), np.float32)
    corner[15:, 15:] = 5
    smooth = _smoothed(corner, corner, along=3, across=0.3)
    assert smooth[15, 15, 0] > 4
    assert smooth[14, 14, 0] < 0.5
    # The line of an edge goes on beyond its end.
    smooth = _smoothed(corner, corner, along=8, across=0.3)
    assert smooth[18:, 18:].min() > 4.7
    constant = np.full((9, 13, 3), 2.5, np.float32)
    for features in (constant, corner[:9, :13].copy(), np.empty((9, 13, 0), np.float32)):
        smooth = _smoothed(constant, features, along=3, across=0.3)
        np.testing.assert_allclose(smooth, 2.5, rtol=1e-5)


def test_smoothing_along_edges_of_a_light_alone() -> None:
    features = np.random.default_rng(6).random((70, 110, 2), np.float32)
    light = np.zeros((70, 110, 3), np.float32)
    light[60:64, 2:5], light[20, 90] = 9, 5
    # Where nothing is lit for far around, nothing is computed; on a pedestal all is.
    alone, lifted = (_smoothed(image, features, along=3, across=0.3) for image in (light, light + 1))
    np.testing.assert_allclose(alone, lifted - 1, atol=1e-5)
    assert alone[:, 40:70].max() == 0 < alone[60:64, 2:5].min()


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (0, 4)])
def test_smoothing_along_edges_of_small_images(size: tuple[int, int]) -> None:
    image = np.random.default_rng(2).random((*size, 3), np.float32)
    smooth = _smoothed(image, image, along=3, across=0.3)
    assert smooth.shape == image.shape
    assert np.isfinite(smooth).all()
    if image.size:
        assert image.min() <= smooth.min() * 1.001
        assert smooth.max() <= image.max() * 1.001
    one, many = (_smoothed(image, image, along=3, across=0.3, threads=n) for n in (1, 4))
    assert one.tobytes() == many.tobytes()


def test_smoothing_along_edges_refuses_what_does_not_fit() -> None:
    image = np.ones((4, 5, 3), np.float32)
    for tensor, message in (
        (image[:3].copy(), r"tensor: expected the height and width of image, \(4, 5\), got \(3, 5\)"),
        (image[:, :, :1].copy(), "tensor: expected 3 channels, got 1"),
    ):
        with pytest.raises(ValueError, match=message):
            _core.smooth_along_edges(image, tensor, along=3, across=0.3, threads=2)


@pytest.mark.parametrize(
    "sigmas",
    [{"along": a} for a in (0, -1, np.nan, np.inf, 3e9, 1073741814, 129)] + [{"across": 1e-30}],
)
def test_smoothing_along_edges_refuses_gaussians_of_no_use(sigmas: dict[str, float]) -> None:
    image = np.ones((4, 5, 3), np.float32)
    with pytest.raises(ValueError, match=r"along and across: expected 0.01\d* to 128"):
        _smoothed(image, image, **{"along": 3, "across": 0.3, **sigmas})


@pytest.mark.parametrize(
    "window",
    [
        *({"radius": radius} for radius in (-1, 257, 2**31 - 4, 2**31 - 1)),
        {"radius": 5, "step": 2},
        *({"radius": 0, "step": step} for step in (0, 2**31 - 1)),
        *({"k": k} for k in (0.0, np.nan, 1e30, np.inf)),
    ],
)
def test_a_window_that_cannot_be_searched_is_refused(window):
    image = np.ones((4, 5, 3), np.float32)
    with pytest.raises(ValueError, match=r"^(radius: expected 0 to 256|step: expected 1|k: expected a)"):
        _core.prefilter_feature(
            image, image, image, None, **{"radius": 5, "step": 1, "k": 0.5, **window}, threads=2
        )
