"""The embedded renderer against scenes whose pictures and features are known in closed form."""

from __future__ import annotations

import os
import signal
import threading
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tungsten_dip.buffers.read import read_buffers
from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.errors import InputError
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.fit.write import write_denoised
from tungsten_dip.hosts.mitsuba.render import _scene_with_integrator, _Statistics, render_translated
from tungsten_dip.hosts.mitsuba.runtime import VERSION, mitsuba_variant
from tungsten_dip.hosts.mitsuba.translated_scene import TranslatedScene
from tungsten_dip.scene.types import PathTracer

mi.set_variant("scalar_rgb")

ALL = ("color", "albedo", "normal", "depth", "visibility")
FOV_DEG = 40.0
CAMERA_Z = 4.0
FROM_FRONT = np.array([[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, CAMERA_Z], [0, 0, 0, 1.0]])
"""A camera at (0, 0, 4) that looks along -z; +x is to the right of the picture."""


def gray(value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": [value] * 3}


def diffuse(value: float) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": gray(value)}}


def placed(kind: str, bsdf: str, z: float = 0.0, scale: float = 1.0, **more: Any) -> dict[str, Any]:
    return {"type": kind, "bsdf": {"type": "ref", "id": bsdf}, "to_world": transform([scale] * 3, z), **more}


def transform(scale: Sequence[float], z: float = 0.0) -> Any:
    matrix = np.diag([*scale, 1.0])
    matrix[2, 3] = z
    return mi.ScalarTransform4f(matrix)


def scene(
    *shapes: dict[str, Any],
    bsdfs: dict[str, tuple[dict[str, Any], float]] | None = None,
    sky: float | None = 1.0,
    size: tuple[int, int] = (12, 9),
    trace: PathTracer | None = None,
    filter_name: str = "box",
    **more: Any,
) -> TranslatedScene:
    """``bsdfs`` maps ids to BSDFs and what Tungsten calls their albedo; ``sky`` is its radiance."""
    bsdfs = bsdfs or {}
    sensor = {
        "type": "perspective",
        "fov": FOV_DEG,
        "to_world": mi.ScalarTransform4f(FROM_FRONT),
        "film": {"type": "hdrfilm", "width": size[0], "height": size[1]},
    }
    parts = {
        "type": "scene",
        **{name: bsdf for name, (bsdf, _) in bsdfs.items()},
        **{f"shape_{i}": shape for i, shape in enumerate(shapes)},
        "sensor": sensor,
        **more,
    }
    if sky is not None:
        parts["sky"] = {"type": "constant", "radiance": gray(sky)}
    return TranslatedScene(
        scene=parts,
        albedo={name: gray(albedo) for name, (_, albedo) in bsdfs.items()},
        integrator=trace or PathTracer(),
        reconstruction_filter=filter_name,  # type: ignore[arg-type]
    )


def ball(size: tuple[int, int] = (12, 9), **more: Any) -> TranslatedScene:
    """A gray ball under a sky: noise from light sampling, edges, and pixels that see nothing but sky."""
    return scene(placed("sphere", "gray"), bsdfs={"gray": (diffuse(0.6), 0.6)}, size=size, **more)


def directions(size: tuple[int, int]) -> np.ndarray:
    """The directions through the pixels' centres, shape (height, width, 3)."""
    width, height = size
    half = np.tan(np.radians(FOV_DEG) / 2)
    x = ((np.arange(width) + 0.5) / width * 2 - 1) * half
    y = (1 - (np.arange(height) + 0.5) / height * 2) * half * height / width
    rays = np.stack([*np.meshgrid(x, y), -np.ones((height, width))], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def is_near(mean: np.ndarray, expected: float, variance: np.ndarray) -> bool:
    """Whether the mean over the picture agrees with what is expected, by 5 standard deviations."""
    return bool(abs(mean.mean() - expected) <= 5 * np.sqrt(variance.sum()) / variance.size + 1e-5)


def test_furnace() -> None:
    buffers = render_translated(ball(), spp=64, quantities=ALL)
    hits = buffers.depth.mean[..., 0] > 2.9
    inner = hits & (buffers.albedo.variance[..., 0] == 0)
    assert inner.sum() > 10
    assert is_near(buffers.color.mean[inner], 0.6, buffers.color.variance[inner])
    np.testing.assert_allclose(buffers.albedo.mean[inner], 0.6, rtol=1e-5)
    np.testing.assert_allclose(buffers.visibility.mean[inner], 1.0)


def test_ray_that_leaves_the_scene() -> None:
    buffers = render_translated(scene(sky=0.25, filter_name="dirac"), spp=2)
    np.testing.assert_allclose(buffers.color.mean, 0.25, rtol=1e-6)
    np.testing.assert_allclose(buffers.albedo.mean, 0.25, rtol=1e-6)
    np.testing.assert_array_equal(buffers.depth.mean, 0)
    np.testing.assert_allclose(buffers.normal.mean, -directions((12, 9)), atol=1e-6)


def test_normal_and_depth_of_a_sphere() -> None:
    size = (31, 17)
    buffers = render_translated(ball(size, filter_name="dirac"), spp=2)
    rays = directions(size)
    b = rays[..., 2] * CAMERA_Z
    discriminant = b**2 - (CAMERA_Z**2 - 1)
    hits = discriminant > 1e-3
    depth = (-b - np.sqrt(np.maximum(discriminant, 0)))[hits]
    assert 50 < hits.sum() < hits.size - 50
    np.testing.assert_allclose(buffers.depth.mean[hits, 0], depth, rtol=1e-4)
    expected = depth[:, None] * rays[hits] + [0, 0, CAMERA_Z]
    np.testing.assert_allclose(buffers.normal.mean[hits], expected, atol=1e-3)


def test_depth_of_a_plane_is_along_the_ray() -> None:
    wall = scene(
        placed("rectangle", "gray", scale=9), bsdfs={"gray": (diffuse(0.5), 0.5)}, filter_name="dirac"
    )
    buffers = render_translated(wall, spp=2)
    np.testing.assert_allclose(buffers.depth.mean[..., 0], -CAMERA_Z / directions((12, 9))[..., 2], rtol=1e-5)
    np.testing.assert_allclose(buffers.normal.mean, np.broadcast_to([0, 0, 1], (9, 12, 3)), atol=1e-6)


def test_features_behind_a_mirror() -> None:
    bsdfs = {"mirror": ({"type": "conductor", "material": "none"}, 1.0), "gray": (diffuse(0.3), 0.3)}
    shapes = (placed("rectangle", "mirror", scale=9), placed("rectangle", "gray", z=6, scale=99))
    buffers = render_translated(scene(*shapes, bsdfs=bsdfs, filter_name="dirac"), spp=2)
    cosine = -directions((12, 9))[..., 2]
    np.testing.assert_allclose(buffers.depth.mean[..., 0], (CAMERA_Z + 6) / cosine, rtol=1e-5)
    np.testing.assert_allclose(buffers.albedo.mean, 0.3, rtol=1e-5)
    np.testing.assert_allclose(buffers.normal.mean, np.broadcast_to([0, 0, 1], (9, 12, 3)), atol=1e-6)


def test_features_behind_glass_are_mixed_with_what_it_reflects() -> None:
    bsdfs = {"glass": ({"type": "dielectric", "int_ior": 1.5}, 1.0), "gray": (diffuse(0.2), 0.2)}
    shapes = (placed("cube", "glass", z=1, scale=0.2), placed("rectangle", "gray", z=-1, scale=99))
    narrow = scene(*shapes, bsdfs=bsdfs, sky=1.0, size=(4, 4))
    narrow.scene["sensor"]["fov"] = 1.0
    buffers = render_translated(narrow, spp=512)
    r = ((1.5 - 1) / (1.5 + 1)) ** 2
    reflectance = 2 * r / (1 + r)  # of both faces together, with all reflections between them
    expected = (1 - reflectance) * 0.2 + reflectance * 1.0
    assert is_near(buffers.albedo.mean[..., 0], expected, buffers.albedo.variance[..., 0])
    assert buffers.albedo.variance.min() > 0


@pytest.mark.parametrize(
    "bsdf", [{"type": "null"}, {"type": "mask", "opacity": 0.0, "bsdf": {"type": "diffuse"}}]
)
def test_features_behind_transparency(bsdf: dict[str, Any]) -> None:
    bsdfs = {"clear": (bsdf, 1.0), "gray": (diffuse(0.3), 0.3)}
    shapes = (placed("rectangle", "clear", z=1, scale=9), placed("rectangle", "gray", scale=9))
    buffers = render_translated(scene(*shapes, bsdfs=bsdfs, filter_name="dirac"), spp=4)
    np.testing.assert_allclose(buffers.albedo.mean, 0.3, rtol=1e-5)
    np.testing.assert_allclose(buffers.depth.mean[..., 0], -CAMERA_Z / directions((12, 9))[..., 2], rtol=1e-5)


def test_half_transparent_ball_is_a_furnace() -> None:
    veil = {"type": "mask", "opacity": 0.5, "bsdf": diffuse(1.0)}
    color = render_translated(scene(placed("sphere", "veil"), bsdfs={"veil": (veil, 1.0)}), spp=64).color
    assert is_near(color.mean, 1.0, color.variance)
    assert color.variance.max() > 0


def test_emission_is_added_to_albedo_on_the_side_that_shines() -> None:
    lamp = {"type": "area", "radiance": gray(3.0)}
    for turn, expected in ((1.0, 0.5 + 3.0), (-1.0, 0.5)):
        shape = placed("rectangle", "gray", scale=9, emitter=lamp)
        shape["to_world"] = transform([9, 9 * turn, turn])
        buffers = render_translated(scene(shape, bsdfs={"gray": (diffuse(0.5), 0.5)}, sky=None), spp=2)
        np.testing.assert_allclose(buffers.albedo.mean, expected, rtol=1e-5)
        np.testing.assert_allclose(buffers.color.mean, expected - 0.5, atol=1e-6)


def room(trace: PathTracer, **more: Any) -> TranslatedScene:
    """The inside of a shining gray cube: bounce n adds 0.5^n."""
    lamp = {"type": "area", "radiance": gray(1.0)}
    walls = placed("cube", "gray", scale=9, flip_normals=True, emitter=lamp)
    return scene(walls, bsdfs={"gray": (diffuse(0.5), 0.5)}, sky=None, trace=trace, **more)


@pytest.mark.parametrize("light_sampling", [True, False])
@pytest.mark.parametrize(
    ("lowest", "highest", "expected"),
    [(0, 1, 1.0), (0, 2, 1.5), (0, 64, 2.0), (1, 64, 1.0), (2, 4, 0.375), (0, 0, 0)],
)
def test_bounces_that_count(lowest: int, highest: int, expected: float, light_sampling: bool) -> None:
    trace = PathTracer(min_bounces=lowest, max_bounces=highest, enable_light_sampling=light_sampling)
    color = render_translated(room(trace), spp=64).color
    assert is_near(color.mean, expected, color.variance)


def test_transparent_surfaces_count_as_bounces() -> None:
    bsdfs = {"clear": ({"type": "null"}, 1.0), "gray": (diffuse(0.5), 0.5)}
    shapes = (placed("rectangle", "gray", scale=9), placed("rectangle", "clear", z=1, scale=99))
    for highest, expected in ((2, 0.0), (3, 0.0), (4, 0.5)):
        trace = PathTracer(max_bounces=highest)
        color = render_translated(scene(*shapes, bsdfs=bsdfs, trace=trace), spp=32).color
        assert is_near(color.mean, expected, color.variance)


def fog(sigma_t: float, albedo: float, trace: PathTracer | None = None) -> TranslatedScene:
    """A cube of fog, 2 thick, that fills the picture, before a gray wall."""
    medium = {"type": "homogeneous", "sigma_t": sigma_t, "albedo": albedo, "phase": {"type": "isotropic"}}
    bsdfs = {"clear": ({"type": "null"}, 1.0), "black": (diffuse(0.0), 0.25)}
    shapes = (placed("cube", "clear", interior=medium), placed("rectangle", "black", z=-2, scale=99))
    fogged = scene(*shapes, bsdfs=bsdfs, trace=trace, sky=1.0, size=(4, 4))
    fogged.scene["sensor"]["fov"] = 1.0
    return fogged


def test_absorption_follows_beer_and_lambert() -> None:
    medium = {"type": "homogeneous", "sigma_t": 0.7, "albedo": 0.0}
    haze = scene(
        placed("cube", "clear", interior=medium), bsdfs={"clear": ({"type": "null"}, 1.0)}, size=(3, 2)
    )
    haze.scene["sensor"]["fov"] = 1.0
    buffers = render_translated(haze, spp=4)
    np.testing.assert_allclose(buffers.color.mean, np.exp(-1.4), rtol=1e-3)
    np.testing.assert_allclose(buffers.albedo.mean, 1.0, rtol=1e-6)


def test_fog_that_absorbs_nothing_is_a_furnace() -> None:
    medium = {"type": "homogeneous", "sigma_t": 1.5, "albedo": 1.0}
    lit = scene(
        placed("cube", "clear", interior=medium),
        bsdfs={"clear": ({"type": "null"}, 1.0)},
        trace=PathTracer(max_bounces=512),
    )
    color = render_translated(lit, spp=128).color
    assert is_near(color.mean, 1.0, color.variance)
    assert color.variance.max() > 0


def test_features_in_fog_are_those_of_paths_that_meet_the_wall_unscattered_or_the_next_surface() -> None:
    buffers = render_translated(fog(0.5, 1.0), spp=256)
    unscattered = np.exp(-1.0)
    # Of the paths that the fog scattered, the next surface is its own boundary, of albedo 1.
    assert is_near(
        buffers.albedo.mean[..., 0], 0.25 * unscattered + (1 - unscattered), buffers.albedo.variance[..., 0]
    )


def test_light_that_the_fog_scattered_once_can_be_left_out() -> None:
    everything = render_translated(fog(0.5, 1.0), spp=256).color
    without = render_translated(fog(0.5, 1.0, PathTracer(low_order_scattering=False)), spp=256).color
    assert 0 < without.mean.mean() < 0.8 * everything.mean.mean()


def test_light_from_surfaces_can_be_left_out() -> None:
    buffers = render_translated(ball(trace=PathTracer(include_surfaces=False)), spp=16)
    np.testing.assert_array_equal(buffers.color.mean[4, 5:7], 0)
    np.testing.assert_allclose(buffers.color.mean[0, 0], 1)


def test_visibility_is_what_arrives_of_the_light() -> None:
    lamp = placed("rectangle", "black", z=30, emitter={"type": "area", "radiance": gray(1.0)})
    lamp["to_world"] = transform([0.1, -0.1, -1], z=30)
    bsdfs = {"gray": (diffuse(0.5), 0.5), "black": (diffuse(0.0), 0.0)}
    floor = placed("rectangle", "gray", scale=9)
    lid = placed("rectangle", "black", z=20, scale=50)
    open_air = render_translated(scene(floor, lamp, bsdfs=bsdfs, sky=None), spp=4, quantities=ALL)
    covered = render_translated(scene(floor, lamp, lid, bsdfs=bsdfs, sky=None), spp=4, quantities=ALL)
    np.testing.assert_array_equal(open_air.visibility.mean, 1)
    np.testing.assert_array_equal(covered.visibility.mean, 0)
    assert open_air.color.mean.min() > 0
    np.testing.assert_array_equal(covered.color.mean, 0)


@pytest.mark.parametrize(("spp", "spp_step"), [(2, 2), (5, 5), (8, 1), (7, 1), (9, 3), (8, 5)])
def test_halves_make_up_the_mean(spp: int, spp_step: int) -> None:
    buffers = render_translated(ball(), spp=spp, timeout_s=1e9, spp_step=spp_step)
    count_a, count_b = (spp + 1) // 2, spp // 2
    for _, buffer in buffers.quantities():
        assert buffer.half_a is not None
        assert buffer.half_b is not None
        pooled = (buffer.half_a * count_a + buffer.half_b * count_b) / spp
        np.testing.assert_allclose(buffer.mean, pooled, rtol=1e-5, atol=1e-6)
    assert np.any(buffers.color.half_a != buffers.color.half_b)


def test_variance_is_that_of_the_mean() -> None:
    renders = [render_translated(ball(), spp=6, seed=seed) for seed in range(40)]
    for name in ("color", "normal"):
        means = np.stack([getattr(r, name).mean for r in renders]).astype(np.float64)
        claimed = np.mean([getattr(r, name).variance for r in renders], axis=0)
        noisy = claimed > 1e-6
        assert noisy.sum() > 50
        assert means.var(axis=0, ddof=1)[noisy].sum() == pytest.approx(claimed[noisy].sum(), rel=0.2)


def test_halves_are_independent() -> None:
    truth = render_translated(ball((24, 18)), spp=2000, seed=1).color.mean
    color = render_translated(ball((24, 18)), spp=8, seed=2).color
    noisy = color.variance[..., 0] > 0
    a, b = (half[noisy][:, 0] - truth[noisy][:, 0] for half in (color.half_a, color.half_b))
    assert abs(np.corrcoef(a, b)[0, 1]) < 4 / np.sqrt(noisy.sum())


def planes(buffers: RenderBuffers) -> list[np.ndarray]:
    return [array for _, buffer in buffers.quantities() for _, array in buffer.planes()]


def test_result_depends_on_the_seed_alone() -> None:
    one = planes(render_translated(ball((37, 21)), spp=3, seed=7, threads=1))
    many = planes(render_translated(ball((37, 21)), spp=3, seed=7, threads=5))
    other = render_translated(ball((37, 21)), spp=3, seed=8, threads=1)
    assert len(one) == 16
    for a, b in zip(one, many, strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.any(other.color.mean != one[0])


def test_a_feature_that_one_ray_recorded_is_not_black_in_the_other_half() -> None:
    one = np.ones((2, 2, 1), np.float32)
    statistics = _Statistics(0.7 * one, 0 * one, one, 0 * one, 0 * one)
    buffer = statistics.buffer(has_halves=True)
    for plane in (buffer.mean, buffer.half_a, buffer.half_b):
        np.testing.assert_allclose(plane, 0.7)


def test_large_seeds_survive_an_exr(tmp_path: Path) -> None:
    buffers = render_translated(ball((5, 4)), spp=2, seed=2**32 - 1, threads=1)
    result = FitResult(buffers.color.mean, FitSettings(), 0.0, 0)
    write_denoised(tmp_path / "a.exr", result, buffers)
    assert read_buffers(tmp_path / "a.exr").attributes["seed"] == str(2**32 - 1)


def test_pixels_have_random_numbers_of_their_own() -> None:
    normal = render_translated(scene(size=(64, 64)), spp=1, seed=3).normal.mean
    offsets = (normal + directions((64, 64)))[..., 0].ravel()
    assert np.unique(offsets).size > 0.99 * offsets.size
    assert abs(np.corrcoef(offsets[1:], offsets[:-1])[0, 1]) < 0.07


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (17, 1), (33, 18)])
def test_sizes(size: tuple[int, int]) -> None:
    buffers = render_translated(scene(size=size), spp=2)
    assert (buffers.width, buffers.height) == size
    np.testing.assert_allclose(buffers.color.mean, 1, rtol=1e-6)


@pytest.mark.parametrize(
    ("filter_name", "width"),
    [("dirac", 0), ("box", 0.289), ("tent", 0.42), ("gaussian", 0.52), ("mitchell_netravali", 0.45),
     ("catmull_rom", 0.38), ("lanczos", 0.39)],
)  # fmt: skip
def test_filters_distribute_the_samples(filter_name: str, width: float) -> None:
    """Where rays leave the scene to tells where the samples lie; ``width`` is their standard deviation."""
    size = (15, 15)
    buffers = render_translated(scene(size=size, filter_name=filter_name), spp=256)
    np.testing.assert_allclose(buffers.color.mean, 1, rtol=1e-5)
    pixel = 2 * np.tan(np.radians(FOV_DEG) / 2) / size[0]
    middle = buffers.normal.variance[7, 7, :2] * 256 / pixel**2
    np.testing.assert_allclose(np.sqrt(middle.mean()), width, rtol=0.12, atol=1e-6)
    offset = (buffers.normal.mean + directions(size))[..., 0] / pixel
    assert abs(offset.mean()) < 0.01


def test_pixel_center() -> None:
    centred = render_translated(scene(filter_name="dirac", size=(8, 8)), spp=1).normal.mean
    translated = scene(filter_name="dirac", size=(8, 8))
    corner = TranslatedScene(
        translated.scene, translated.albedo, reconstruction_filter="dirac", pixel_center=0.0
    )
    cornered = render_translated(corner, spp=1).normal.mean
    pixel = 2 * np.tan(np.radians(FOV_DEG) / 2) / 8
    slope = centred[..., 0] / centred[..., 2] - cornered[..., 0] / cornered[..., 2]
    np.testing.assert_allclose(slope, -pixel / 2, rtol=1e-4)


def test_one_sample_has_no_halves() -> None:
    color = render_translated(ball(), spp=1).color
    assert color.half_a is None
    assert color.half_b is None
    assert color.variance is None


def test_a_timeout_ends_the_render_after_a_pass() -> None:
    buffers = render_translated(ball(), spp=12, timeout_s=0.0, spp_step=3)
    assert buffers.spp == 3


def test_passes_pool_to_one_render() -> None:
    buffers = render_translated(ball(), spp=96, timeout_s=1e9, spp_step=5)
    whole = render_translated(ball(), spp=96, seed=1)
    assert buffers.spp == 96
    for name in ("color", "normal"):
        passes, at_once = getattr(buffers, name), getattr(whole, name)
        error = (passes.mean - at_once.mean) / np.sqrt(passes.variance + at_once.variance + 1e-9)
        assert np.sqrt((error**2).mean()) == pytest.approx(1, abs=0.3)
        assert passes.variance.sum() == pytest.approx(at_once.variance.sum(), rel=0.1)


def test_only_what_is_asked_for() -> None:
    buffers = render_translated(ball(), spp=2, quantities=("color", "depth"))
    assert [name for name, _ in buffers.quantities()] == ["color", "depth"]


def test_progress_runs_to_the_end() -> None:
    fractions: list[float] = []
    render_translated(ball((64, 64)), spp=64, progress=lambda fraction, _: fractions.append(fraction))
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


def test_interrupt_ends_the_render() -> None:
    handler = signal.getsignal(signal.SIGINT)
    started = threading.Event()

    def interrupt() -> None:
        started.wait()
        os.kill(os.getpid(), signal.SIGINT)

    sender = threading.Thread(target=interrupt)
    sender.start()
    with pytest.raises(KeyboardInterrupt):
        render_translated(ball((256, 256)), spp=1_000_000, progress=lambda *_: started.set())
    sender.join()
    assert signal.getsignal(signal.SIGINT) is handler
    assert np.isfinite(render_translated(ball(), spp=2).color.mean).all()


def test_a_failing_progress_callback_ends_the_render() -> None:
    def fail(_fraction: float, _message: str) -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        render_translated(ball((256, 256)), spp=1_000_000, progress=fail)


def test_cancel_ends_a_path_without_end() -> None:
    mirror = {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}}
    hall = scene(
        placed("sphere", "mirror", scale=9),
        bsdfs={"mirror": (mirror, 1.0)},
        trace=PathTracer(max_bounces=2**31 - 1),
    )
    with mitsuba_variant():
        loaded = mi.load_dict(_scene_with_integrator(hall, 1, ALL))
    integrator, sensor = loaded.integrator(), loaded.sensors()[0]
    path = threading.Thread(target=integrator.render, args=(loaded, sensor, 0, 1), daemon=True)
    path.start()
    path.join(1.0)
    assert path.is_alive()
    integrator.cancel()
    path.join(60.0)
    assert not path.is_alive()


@pytest.mark.parametrize(
    "arguments",
    [
        {"spp": 0},
        {"spp": 1, "seed": -1},
        {"spp": 1, "threads": 0},
    ],
)
def test_arguments_out_of_range(arguments: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="expected a whole number"):
        render_translated(ball(), **arguments)


def test_a_scene_that_mitsuba_cannot_load() -> None:
    with pytest.raises(InputError, match="no_such_shape"):
        render_translated(scene({"type": "no_such_shape"}), spp=1)


def test_without_mitsuba_the_message_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tungsten_dip.extras.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'tungsten-dip\[mitsuba\]'"):
        render_translated(ball(), spp=1)


def test_plugins_are_built_for_the_release_that_loads_them() -> None:
    root = Path(__file__).parents[2]
    project = tomllib.loads((root / "pyproject.toml").read_text())
    pins = (root / "constraints.txt").read_text().split()
    needed = [pin for pin in pins if pin.startswith(("mitsuba==", "nanobind=="))]
    assert f"mitsuba=={VERSION}" in needed
    assert set(needed) <= set(project["build-system"]["requires"])
    assert project["project"]["optional-dependencies"]["mitsuba"] == [f"mitsuba=={VERSION}"]
    header = (root / "mitsuba_ext" / "tungsten_plugin.hpp").read_text()
    assert f'static_assert(std::string_view(MI_VERSION) == "{VERSION}"' in header


def test_mitsuba_writes_nothing_to_stdout(capfd: pytest.CaptureFixture[str]) -> None:
    render_translated(ball(), spp=2)
    assert capfd.readouterr() == ("", "")
