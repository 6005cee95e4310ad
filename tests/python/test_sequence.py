from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

import moving_camera
from moving_camera import HEIGHT, WIDTH, true_frame
from synthetic import relmse, synthetic_render
from tungsten_dip.buffers.image_file import write_exr, write_image
from tungsten_dip.buffers.read import read_buffers
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.buffers.source import Part
from tungsten_dip.errors import InputError
from tungsten_dip.fit import denoise
from tungsten_dip.fit.network import blend_network, training
from tungsten_dip.fit.presets import FOLLOWING_DRAFT_PILOTS, FOLLOWING_PILOTS
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.fit.write import write_denoised
from tungsten_dip.graphs.sessions import session_from_proto
from tungsten_dip.scene.types import EquirectangularCamera, PinholeCamera, ThinlensCamera
from tungsten_dip.sequence.flicker import estimated_flicker, flicker
from tungsten_dip.sequence.following import Follower, Models, _typical_error
from tungsten_dip.sequence.frames import RECORD, find_frames, numbers_from_text, text_from_numbers
from tungsten_dip.sequence.reprojection import _neighbours, check_camera, reproject
from tungsten_dip.sequence.work import Run

DRAFT = FitSettings(preset="draft", threads=1)


# --- Which files are frames ---


@pytest.mark.parametrize(
    ("text", "numbers"), [("7", (7,)), ("1-3", (1, 2, 3)), ("5,1-2,2", (1, 2, 5)), ("0 , 3-3", (0, 3))]
)
def test_numbers_are_read(text, numbers):
    assert numbers_from_text(text) == numbers
    assert numbers_from_text(text_from_numbers(numbers)) == numbers


def test_numbers_are_listed_as_ranges():
    assert text_from_numbers([1, 3, 4, 5, 9, 10]) == "1, 3-5, 9-10"


@pytest.mark.parametrize("text", ["", "a", "3-1", "1-", "-3", "1,,2", "1-999999999", "1.5"])
def test_other_numbers_are_refused_in_one_line(text):
    with pytest.raises(InputError, match=r"^frames .*expected numbers such as") as caught:
        numbers_from_text(text)
    assert "\n" not in str(caught.value)


@pytest.fixture
def folders(tmp_path):
    for name in ("f0001", "f0003", "f0010", "f2", "g0001", "f00012"):
        (tmp_path / name).mkdir()
    return tmp_path


@pytest.mark.parametrize("pattern", ["f####", "f%04d"])
def test_a_pattern_finds_exactly_the_frames_of_its_width(folders, pattern):
    frames = find_frames(f"{folders}/{pattern}", "out/f##.exr")
    assert [frame.number for frame in frames] == [1, 3, 10]
    assert [str(frame.output) for frame in frames] == ["out/f01.exr", "out/f03.exr", "out/f10.exr"]
    assert frames[0].input == folders / "f0001"


def test_a_relative_pattern_and_its_scenes(folders, monkeypatch):
    monkeypatch.chdir(folders)
    (frame,) = find_frames("./f#", "o%d.exr", scenes="s%03d.json")
    assert (frame.number, frame.input, frame.output) == (2, Path("f2"), Path("o2.exr"))
    assert frame.scene == Path("s002.json")


def test_a_glob_is_numbered_by_the_last_digits(folders):
    (folders / "shot2_f0007.exr").touch()
    (folders / "shot2_f0005.exr").touch()
    frames = find_frames(f"{folders}/shot2_*.exr", "f####.exr")
    assert [frame.number for frame in frames] == [5, 7]
    assert [f.input.name for f in find_frames(f"{folders}/s*", "f#.exr", (7,))] == ["shot2_f0007.exr"]


def test_a_glob_matches_hidden_files_only_if_it_begins_with_a_dot(tmp_path):
    for name in ("f1.exr", ".f2.exr"):
        (tmp_path / name).touch()
    (tmp_path / ".f1-00c0ffee.tungsten-dip.exr").touch()  # as a writer leaves that was killed
    assert [each.input.name for each in find_frames(f"{tmp_path}/*.exr", "o#.exr")] == ["f1.exr"]
    assert [each.input.name for each in find_frames(f"{tmp_path}/.f?.exr", "o#.exr")] == [".f2.exr"]


@pytest.mark.parametrize("outputs", ["f####.exr", "f#_v2.exr", "../{}/f%d.exr"])
def test_results_that_a_glob_matches_are_no_frames(tmp_path, fitted, frame, outputs):
    for number in (0, 1, 2):
        (tmp_path / f"f{number:04d}").mkdir()
    outputs = f"{tmp_path}/{outputs.format(tmp_path.name)}"
    frames = find_frames(f"{tmp_path}/f*", outputs)
    result = replace(frame.buffers, attributes={RECORD: "{}"})
    for each in frames[:2]:
        write_denoised(each.output, fitted, result)
    assert find_frames(f"{tmp_path}/f*", outputs) == frames
    (tmp_path / "f0001").rmdir()
    assert [each.number for each in find_frames(f"{tmp_path}/f*", outputs)] == [0, 2]


def test_inputs_that_are_named_like_results_are_frames(tmp_path, fitted, frame):
    for number in (1, 9, 10):
        write_denoised(tmp_path / f"f{number}.exr", fitted, frame.buffers)
    frames = find_frames(f"{tmp_path}/f*.exr", f"{tmp_path}/f##.exr")
    assert [each.input.name for each in frames] == ["f1.exr", "f9.exr", "f10.exr"]
    write_denoised(tmp_path / "f01_again.exr", fitted, frame.buffers)
    write_image(tmp_path / "f1.exr", frame.reference)
    with pytest.raises(InputError, match=r"f01_again\.exr and .*f1\.exr: both are frame 1"):
        find_frames(f"{tmp_path}/f*.exr", f"{tmp_path}/f#.exr")


def test_brackets_in_a_pattern_with_numbers_are_plain(tmp_path):
    (tmp_path / "[a] 1").mkdir()
    assert [frame.number for frame in find_frames(f"{tmp_path}/[a] #", "o#.exr")] == [1]


def test_signs_in_a_folders_name_are_no_places_where_there_are_longer_ones(tmp_path):
    for name in ("take#2", "50%done"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "f0007").mkdir()
        (frame,) = find_frames(f"{tmp_path}/{name}/f####", f"out/{name}/f%04d.exr")
        assert (frame.number, frame.input) == (7, tmp_path / name / "f0007")
        assert str(frame.output) == f"out/{name}/f0007.exr"
    (frame,) = find_frames(f"{tmp_path}/take#2/f####", "r####/f####.exr")
    assert str(frame.output) == "r0007/f0007.exr"


@pytest.mark.parametrize("name", ["sh#2", "50%done"])
def test_a_single_sign_in_a_folders_name_is_no_place(tmp_path, name):
    (tmp_path / name / "f0007").mkdir(parents=True)
    folder = f"{tmp_path}/{name}"
    for inputs in (f"{folder}/f*", f"{folder}/f000#", f"{folder}/f000%d/"):
        (frame,) = find_frames(inputs, f"{folder}/o#.exr", scenes=f"{folder}/c0.json")
        assert (frame.number, frame.input) == (7, tmp_path / name / "f0007")
        assert (str(frame.output), str(frame.scene)) == (f"{folder}/o7.exr", f"{folder}/c0.json")
    with pytest.raises(InputError, match="place for the frame's number"):
        find_frames(f"{folder}/f*", f"{folder}/o.exr")


def test_frames_asked_for_need_not_exist(folders):
    frames = find_frames(f"{folders}/f####", "o####.exr", (1, 2))
    assert [frame.input.exists() for frame in frames] == [True, False]


@pytest.mark.parametrize(
    ("numbers", "previous"),
    [
        ((7,), [None]),
        ((1, 2, 4, 5), [None, 1, None, 4]),
        ((1, 3, 5, 9), [None, 1, 3, None]),
        ((10, 20, 30), [None, 10, 20]),
    ],
)
def test_a_frame_knows_the_one_right_before_it(numbers, previous):
    assert [frame.previous for frame in find_frames("f####", "o####.exr", numbers)] == previous


@pytest.mark.parametrize(
    ("inputs", "outputs", "match"),
    [
        ("f####", "out.exr", "place for the frame's number"),
        ("f0001", "o####.exr", "place for the frame's number"),
        ("nothing####", "o####.exr", "no such frames"),
        ("no*", "o####.exr", "no such frames"),
        ("?0001", "o####.exr", "both are frame 1"),
        ("nothing**", "o####.exr", "is no pattern for files|no such frames"),
    ],
)
def test_patterns_that_name_no_frames_are_refused(folders, inputs, outputs, match):
    with pytest.raises(InputError, match=match):
        find_frames(f"{folders}/{inputs}", outputs)


# --- Moving the previous frame into place ---


def test_what_is_moved_is_what_the_camera_sees(tmp_path):
    before, now = (true_frame(tmp_path, shift, seed=0) for shift in (0.0, 0.5))
    truth = before.reference, 2 * before.reference
    moved_a, moved_b = reproject(truth, before.buffers, before.camera, now.buffers, now.camera, threads=2)
    seen = np.isfinite(moved_a[:, :, 0])
    assert seen.mean() > 0.85
    still = np.abs(before.reference - now.reference)[seen]
    error = np.abs(moved_a - now.reference)[seen]
    assert error.mean() < 0.1 * still.mean()
    assert still.mean() > 0.02
    # Each half comes from the same half alone.
    np.testing.assert_allclose(moved_b[seen], 2 * moved_a[seen], rtol=1e-5)
    np.testing.assert_array_equal(np.isnan(moved_a), np.isnan(moved_b))


def test_what_is_moved_to_a_half_takes_nothing_of_the_albedo_from_the_other(tmp_path):
    """What it shared with the half that scores it would pass for truth."""
    before, now = (true_frame(tmp_path, shift, seed=0) for shift in (0.0, 0.1))
    albedo = now.buffers.albedo.mean
    truth = before.reference, before.reference

    def moved(half_b):
        buffers = now.buffers.with_quantities(albedo=Buffer(albedo, albedo, half_b))
        return reproject(truth, before.buffers, before.camera, buffers, now.camera, threads=2)

    (a, b), (a_now, b_now) = moved(albedo), moved(albedo * np.float32(1.25))
    np.testing.assert_array_equal(a, a_now)
    assert np.nanmax(np.abs(b - b_now)) > 0.02


def test_dark_surfaces_beside_black_ones_are_not_lit_up(tmp_path):
    """Only the light on a surface is divided by its albedo: black ones must not take it for their own."""
    frame = true_frame(tmp_path, 0.0, seed=0)
    color = np.full_like(frame.reference, 0.01)

    def with_albedo(value):
        return frame.buffers.with_quantities(albedo=Buffer(np.full_like(color, value)))

    for before, now in ((0.002, 0.0), (0.0, 0.002)):
        moved, _ = reproject(
            (color, color), with_albedo(before), frame.camera, with_albedo(now), frame.camera, threads=2
        )
        np.testing.assert_allclose(moved, 0.01, rtol=0.2)


@pytest.mark.parametrize("lens", ["pinhole", "thinlens"])
def test_a_camera_that_stands_still_moves_nothing(tmp_path, lens):
    frame = true_frame(tmp_path, 0.1, seed=0)
    camera = frame.camera
    if lens == "thinlens":
        # Its pixels' middles are elsewhere (`scene.types`).
        camera = ThinlensCamera(**{f.name: getattr(camera, f.name) for f in fields(camera) if f.init})
    moved, _ = reproject(
        (frame.reference, frame.reference), frame.buffers, camera, frame.buffers, camera, threads=2
    )
    np.testing.assert_allclose(moved, frame.reference, rtol=1e-3)


def test_a_camera_far_from_the_origin_moves_the_same(tmp_path):
    before, now = (true_frame(tmp_path, shift, seed=0) for shift in (0.0, 0.3))

    def moved(offset):
        cameras = []
        for frame in (before, now):
            world_from_local = np.array(frame.camera.world_from_local, np.float64)
            world_from_local[:3, 3] += offset
            cameras.append(replace(frame.camera, world_from_local=world_from_local))
        truth = before.reference, before.reference
        return reproject(truth, before.buffers, cameras[0], now.buffers, cameras[1], threads=2)[0]

    np.testing.assert_allclose(moved(1.2e6 + 0.04), moved(0.0), rtol=1e-3)


def test_a_scaled_camera_sees_the_same(tmp_path):
    before, now = (true_frame(tmp_path, shift, seed=0) for shift in (0.0, 0.3))
    truth = before.reference, before.reference
    moved = [
        reproject(
            truth,
            before.buffers,
            replace(before.camera, world_from_local=np.asarray(before.camera.world_from_local) @ scale),
            now.buffers,
            replace(now.camera, world_from_local=np.asarray(now.camera.world_from_local) @ scale),
            threads=2,
        )[0]
        for scale in (np.eye(4), np.diag([2.0, 3.0, 0.5, 1.0]))
    ]
    np.testing.assert_allclose(moved[1], moved[0], rtol=1e-3)


@pytest.mark.parametrize(("factor", "same"), [(1.01, True), (1.04, False), (0.96, False)])
def test_surfaces_are_told_apart_by_a_few_percent_of_their_distance(tmp_path, factor, same):
    frame = true_frame(tmp_path, 0.0, seed=0)
    depth = frame.buffers.depth.mean.copy()
    depth[12, 24] *= np.float32(factor)
    moved, _ = reproject(
        (frame.reference, frame.reference),
        frame.buffers.with_quantities(depth=Buffer(depth)),
        frame.camera,
        frame.buffers,
        frame.camera,
        threads=2,
    )
    assert np.isfinite(moved[12, 24]).all() == same
    assert np.isfinite(moved).all(axis=2).sum() >= WIDTH * HEIGHT - 1


def test_a_sliver_of_a_pixel_is_not_taken_for_a_surface(tmp_path):
    """Single pixels show the surface: each is seen where it makes up a quarter, not all around it."""
    before, now = (true_frame(tmp_path, shift, seed=0) for shift in (0.0, 0.3))
    depth = 2 * before.buffers.depth.mean
    alone = np.zeros((HEIGHT, WIDTH), bool)
    alone[14::4, 2::4] = True
    depth[alone] /= 2
    moved, _ = reproject(
        (before.reference, before.reference),
        before.buffers.with_quantities(depth=Buffer(depth)),
        before.camera,
        now.buffers,
        now.camera,
        threads=2,
    )
    seen = np.isfinite(moved[:, :, 0]) & (now.buffers.depth.mean[:, :, 0] > 0)
    # (1 - x) (1 - y) >= 1/4 holds on an area of 1.6 pixels of 4.
    assert 1.2 < seen.sum() / alone.sum() < 2.0


def test_the_sky_is_not_what_stood_before_it(tmp_path):
    """Features but the depth are left out: it alone tells."""
    now = true_frame(tmp_path, 0.0, seed=0)
    buffers = now.buffers.with_quantities(albedo=None, normal=None)
    depth = now.buffers.depth.mean.copy()
    sky = depth[:, :, 0] == 0
    depth[:, :24][sky[:, :24]] = 3
    moved, _ = reproject(
        (now.reference, now.reference),
        buffers.with_quantities(depth=Buffer(depth)),
        now.camera,
        buffers,
        now.camera,
        threads=2,
    )
    assert np.isnan(moved[:, :24][sky[:, :24]]).all()
    assert np.isfinite(moved[:, 24:][sky[:, 24:]]).all()


def test_the_sky_moves_with_its_direction(tmp_path):
    before, now = (true_frame(tmp_path, shift, seed=0) for shift in (0.0, 0.1))
    sky = now.buffers.depth.mean[:, :, 0] == 0
    assert sky.any()
    moved, _ = reproject(
        (before.reference, before.reference),
        before.buffers,
        before.camera,
        now.buffers,
        now.camera,
        threads=1,
    )
    assert np.isfinite(moved[sky]).all(axis=1).mean() > 0.8
    np.testing.assert_allclose(moved[sky & np.isfinite(moved[:, :, 0])], 0.2, rtol=1e-3)


@pytest.mark.parametrize("quantity", ["depth", "normal", "albedo"])
def test_another_surface_is_rejected(tmp_path, quantity):
    frame = true_frame(tmp_path, 0.0, seed=0)
    changed = getattr(frame.buffers, quantity).mean.copy()
    changed[10:16, 20:30] = changed[10:16, 20:30] * np.float32(1.5) + np.float32(0.5)
    buffers = frame.buffers.with_quantities(**{quantity: Buffer(changed)})
    moved, _ = reproject(
        (frame.reference, frame.reference), buffers, frame.camera, frame.buffers, frame.camera, threads=2
    )
    assert np.isnan(moved[11:15, 21:29]).all()
    assert np.isfinite(moved[:9]).all()


def test_what_lies_behind_the_previous_camera_is_not_seen(tmp_path):
    frame = true_frame(tmp_path, 0.0, seed=0)
    turned = np.asarray(frame.camera.world_from_local) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    moved, _ = reproject(
        (frame.reference, frame.reference),
        frame.buffers,
        replace(frame.camera, world_from_local=turned),
        frame.buffers,
        frame.camera,
        threads=2,
    )
    assert np.isnan(moved).all()


def test_a_camera_of_another_picture_is_refused(tmp_path):
    buffers = true_frame(tmp_path, 0.0, seed=0).buffers
    check_camera(PinholeCamera(resolution=(2 * WIDTH, 2 * HEIGHT)), buffers)
    with pytest.raises(InputError, match="the camera takes 100x100 pixels"):
        check_camera(PinholeCamera(resolution=(100, 100)), buffers)
    with pytest.raises(InputError, match="expected pinhole or thinlens"):
        check_camera(EquirectangularCamera(resolution=(WIDTH, HEIGHT)), buffers)


def test_a_part_of_the_cameras_picture_is_refused(tmp_path):
    camera = PinholeCamera(resolution=(WIDTH, HEIGHT))
    channels = dict.fromkeys("RGB", np.ones((HEIGHT // 2, WIDTH // 2), np.float32))
    whole = ((0, 0), (WIDTH - 1, HEIGHT - 1))
    crop = ((4, 2), (4 + WIDTH // 2 - 1, 2 + HEIGHT // 2 - 1))
    for display, refused in ((crop, False), (whole, True)):
        attributes = {"dataWindow": crop, "displayWindow": display}
        write_exr(tmp_path / "a.exr", [Part(channels, attributes)])
        buffers = read_buffers(tmp_path / "a.exr")
        if refused:
            with pytest.raises(InputError, match=r"got 24x16 pixels from \(4, 2\) of it; render without"):
                check_camera(camera, buffers)
        else:
            check_camera(camera, buffers)


def test_a_whole_picture_of_which_a_part_is_displayed_is_not_refused(tmp_path):
    channels = dict.fromkeys("RGB", np.ones((HEIGHT, WIDTH), np.float32))
    overscan = {
        "dataWindow": ((-5, -5), (WIDTH - 6, HEIGHT - 6)),
        "displayWindow": ((0, 0), (WIDTH - 11, HEIGHT - 11)),
    }
    write_exr(tmp_path / "a.exr", [Part(channels, overscan)])
    check_camera(PinholeCamera(resolution=(WIDTH, HEIGHT)), read_buffers(tmp_path / "a.exr"))


# --- Flicker ---


def test_flicker_is_what_the_truth_does_not_do():
    rng = np.random.default_rng(0)
    before, now, offset = (rng.random((7, 5, 3), np.float32) for _ in range(3))
    assert flicker(now + offset, before + offset, now, before) == pytest.approx(0, abs=1e-12)
    ones = np.ones((3, 4, 3), np.float32)
    assert flicker(1.1 * ones, ones, ones, ones) == pytest.approx(0.01 / 1.01, rel=1e-4)


@pytest.mark.parametrize("bias", [0.0, 0.02])
def test_the_halves_tell_the_flicker(bias):
    """A result with noise of its own half and an error that changes: the estimate meets the truth."""
    rng = np.random.default_rng(1)
    shape, noise = (300, 400, 3), 0.1
    references = [0.5 + 0.3 * rng.random(shape), 0.5 + 0.3 * rng.random(shape)]
    noisy = [[r + noise * rng.standard_normal(shape) for _ in "ab"] for r in references]
    # A tenth of a half's noise is left in what is made of it, and a bias of alternating sign.
    denoised = [
        [r + 0.1 * (half - r) + sign * bias for half in halves]
        for r, halves, sign in zip(references, noisy, (-1, 1), strict=True)
    ]
    noisy, denoised = (
        [tuple(np.float32(h) for h in halves) for halves in pair] for pair in (noisy, denoised)
    )
    true = flicker(
        *(np.mean(halves, axis=0) for halves in denoised[::-1]), *map(np.float32, references[::-1])
    )
    known = 2 * (0.1 * noise) ** 2 / 2 + (2 * bias) ** 2
    denominator = np.mean([np.mean(r**2) for r in references]) + 0.01
    assert true == pytest.approx(known / denominator, rel=0.1)
    estimate = estimated_flicker(denoised[1], denoised[0], noisy[1], noisy[0])
    assert estimate == pytest.approx(true, rel=0.15)


def test_halves_too_noisy_to_tell_the_flicker_tell_that_of_the_noise():
    """Results whose noise is 0.05 each, whatever they were made of."""
    rng = np.random.default_rng(2)
    shape = (60, 80, 3)
    noisy, noisy_before = (
        tuple(np.float32(0.5 + 30 * rng.standard_normal(shape)) for _ in "ab") for _ in range(2)
    )
    denoised, before = (
        tuple(np.float32(0.5 + 0.05 * rng.standard_normal(shape)) for _ in "ab") for _ in range(2)
    )
    estimate = estimated_flicker(denoised, before, noisy, noisy_before)
    assert estimate == pytest.approx(0.05**2 / (0.5**2 + 0.01), rel=0.1)


# --- One frame after another ---


def test_frames_follow_and_gain_from_it(tmp_path):
    frames = [true_frame(tmp_path, 0.05 * n, seed=n) for n in range(4)]
    follower = Follower(DRAFT)
    followed = [follower.denoise(frame.buffers, frame.camera) for frame in frames]
    assert [f.how for f in followed] == ["fitted", "followed", "followed", "followed"]
    assert followed[0].flicker is None
    assert all(f.flicker is not None and f.flicker > 0 for f in followed[1:])
    cold = [Follower(DRAFT).denoise(frame.buffers).result.color for frame in frames]
    results = [f.result.color for f in followed]
    errors, cold_errors = (
        [relmse(image, frame.reference) for image, frame in zip(images, frames, strict=True)]
        for images in (results, cold)
    )
    assert errors[-1] < 0.8 * cold_errors[-1]
    shown, shown_cold = (
        flicker(images[3], images[2], frames[3].reference, frames[2].reference) for images in (results, cold)
    )
    assert shown < 0.8 * shown_cold


@pytest.mark.parametrize("preset", ["draft", "balanced"])
def test_a_shadow_that_moves_is_little_worse_than_in_a_first_frame(tmp_path, preset):
    settings = FitSettings(preset=preset, threads=1)
    follower, columns = Follower(settings), np.indices((HEIGHT, WIDTH, 1))[1]
    followed, alone = [], []
    for n in range(5):
        shade = np.where((columns - 4 * n) % 24 < 8, 0.1, 1.0)
        frame = true_frame(tmp_path, 0.0, seed=n, shade=shade)
        followed.append(relmse(follower.denoise(frame.buffers, frame.camera).result.color, frame.reference))
        alone.append(relmse(denoise(frame.buffers, settings).color, frame.reference))
    assert sum(followed[1:]) < 2 * sum(alone[1:])


@pytest.mark.parametrize(
    ("preset", "pilots"), [("draft", FOLLOWING_DRAFT_PILOTS), ("balanced", FOLLOWING_PILOTS)]
)
def test_followed_frames_have_few_pilots_of_their_own(tmp_path, preset, pilots):
    follower = Follower(FitSettings(preset, seed=1))
    frames = [true_frame(tmp_path, 0.05 * n, seed=n) for n in range(2)]
    followed = [follower.denoise(frame.buffers, frame.camera) for frame in frames]
    assert follower.models.following.blend.layout.pilots == pilots
    assert follower.models.following.blend.layout.extra_count == 1
    assert relmse(followed[1].result.color, frames[1].reference) < 0.3 * relmse(
        frames[1].buffers.color.mean, frames[1].reference
    )


@pytest.mark.parametrize("refit", [-1, "foo", 0.5, 10**9 + 1])
def test_a_refit_that_cannot_be_done_is_named(refit):
    with pytest.raises(InputError, match="refit, unless auto: expected a whole number from 0 to"):
        Run(DRAFT, refit)


@pytest.mark.parametrize("refit", [0, np.int64(3)])
def test_refit_bounds_the_steps(tmp_path, refit):
    follower = Follower(DRAFT, refit)
    followed = [
        follower.denoise(frame.buffers, frame.camera)
        for frame in (true_frame(tmp_path, 0.05 * n, seed=n) for n in range(3))
    ]
    assert [f.how for f in followed] == ["fitted", "followed", "followed"]
    assert followed[2].result.iterations <= refit


def test_frames_without_cameras_start_from_the_first_ones_network(tmp_path):
    frames = [true_frame(tmp_path, 0.05 * n, seed=n) for n in range(2)]
    follower = Follower(DRAFT, 0)
    first, second = (follower.denoise(frame.buffers) for frame in frames)
    assert (first.how, second.how) == ("fitted", "followed")
    assert second.result.iterations == 0
    assert follower.models.following is None
    assert relmse(second.result.color, frames[1].reference) < 0.3 * relmse(
        frames[1].buffers.color.mean, frames[1].reference
    )


def test_a_frame_of_which_half_is_new_is_no_cut(tmp_path):
    before, now = (true_frame(tmp_path, shift, seed=n) for n, shift in enumerate((0.0, 1.5)))
    truth = before.reference, before.reference
    moved, _ = reproject(truth, before.buffers, before.camera, now.buffers, now.camera, threads=2)
    assert 0.4 < np.isfinite(moved).mean() < 0.75
    follower = Follower(replace(DRAFT, iterations=5))
    follower.denoise(before.buffers, before.camera)
    assert follower.denoise(now.buffers, now.camera).how == "followed"


def test_frames_with_noisy_albedos_follow(tmp_path):
    """Of one surface, two samples of the albedo differ by more than those of two surfaces may."""
    follower = Follower(replace(DRAFT, iterations=5))
    how = []
    for n in range(2):
        frame = true_frame(tmp_path, 0.05 * n, seed=n)
        rng = np.random.default_rng(n)
        truth = frame.buffers.albedo.mean
        a, b = (np.float32(truth + 0.2 * rng.standard_normal(truth.shape)).clip(0) for _ in range(2))
        buffers = frame.buffers.with_quantities(albedo=Buffer((a + b) / 2, a, b))
        how.append(follower.denoise(buffers, frame.camera).how)
    assert how == ["fitted", "followed"]


def test_the_network_of_followed_frames_is_trained_in_full(tmp_path):
    frames = [true_frame(tmp_path, 0.05 * n, seed=n) for n in range(2)]
    follower = Follower(replace(DRAFT, iterations=5))
    followed = [follower.denoise(frame.buffers, frame.camera).result for frame in frames]
    assert [result.iterations for result in followed] == [5, 240]


def test_the_network_of_followed_frames_of_few_pixels_is_trained_less(tmp_path, monkeypatch):
    monkeypatch.setattr(moving_camera, "WIDTH", 24)
    monkeypatch.setattr(moving_camera, "HEIGHT", 16)
    frames = [true_frame(tmp_path, 0.05 * n, seed=n) for n in range(2)]
    follower = Follower(DRAFT)
    followed = [follower.denoise(frame.buffers, frame.camera) for frame in frames]
    assert [frame.how for frame in followed] == ["fitted", "followed"]
    assert [frame.result.iterations for frame in followed] == [40, 40]


@pytest.mark.parametrize("refit", ["auto", 3])
@pytest.mark.parametrize(
    ("with_cameras", "how", "steps"),
    [(True, "followed", [80, 240, 240]), (False, "cut", [80, 80, 80])],
)
def test_a_new_network_is_trained_in_full_whatever_the_refit(
    tmp_path, monkeypatch, refit, with_cameras, how, steps
):
    monkeypatch.setattr(training, "_STRANGE", -1.0)  # so that no network applies to another frame
    follower = Follower(DRAFT, refit)
    frames = [true_frame(tmp_path, 0.05 * n, seed=n) for n in range(3)]
    followed = [follower.denoise(frame.buffers, frame.camera if with_cameras else None) for frame in frames]
    assert [f.how for f in followed] == ["fitted", how, how]
    assert [f.result.iterations for f in followed] == steps
    newest = follower.models.following if with_cameras else follower.models.alone
    assert newest is followed[2].result.model


@pytest.mark.parametrize("refit", [0, 3])
def test_every_frame_is_denoised_on_the_device_of_the_settings(tmp_path, monkeypatch, refit):
    def listed(proto, threads, device="auto"):
        devices.append(device)
        return session_from_proto(proto, threads, device)

    devices = []
    monkeypatch.setattr(blend_network, "session_from_proto", listed)
    settings = replace(DRAFT, device="cpu", seed=1)
    follower = Follower(settings, refit)
    for n in range(2):
        frame = true_frame(tmp_path, 0.05 * n, seed=n)
        result = follower.denoise(frame.buffers).result
    assert result.settings == replace(settings, iterations=refit or None)
    assert set(devices) == {"cpu"}


def test_a_few_outliers_tell_of_no_cut(fitted):
    error = np.full((20, 30, 1), 0.01, np.float32)
    error[3:5], error[7, 7] = 0, 1e6
    assert _typical_error(replace(fitted, error=error)) == pytest.approx(0.01)
    assert _typical_error(replace(fitted, error=0 * error)) is None
    assert _typical_error(replace(fitted, error=None)) is None


def test_a_cut_is_told_by_what_is_in_sight(tmp_path):
    follower = Follower(DRAFT)
    before = true_frame(tmp_path, 0.0, seed=0)
    follower.denoise(before.buffers, before.camera)
    now = true_frame(tmp_path, 30.0, seed=1)
    assert follower.denoise(now.buffers, now.camera).how == "cut"


def test_a_cut_is_told_by_another_size_and_by_the_error(caplog):
    caplog.set_level("INFO", logger="tungsten_dip")
    follower = Follower(DRAFT, 0)
    follower.denoise(synthetic_render(spp=4096).buffers)
    assert follower.denoise(synthetic_render(spp=2, seed=1).buffers).how == "cut"
    assert "a cut: the error, relative to radiance^2 + 0.01, is" in caplog.text
    assert follower.denoise(synthetic_render(20, 30).buffers).how == "cut"


@pytest.mark.parametrize("by", ["sight", "size", "error"])
def test_after_a_cut_frames_follow_with_a_new_network(tmp_path, by):
    follower = Follower(DRAFT, 0)
    for n in range(2):
        frame = true_frame(tmp_path, 0.05 * n, seed=n)
        follower.denoise(frame.buffers, frame.camera)
    assert follower.models.following is not None
    first = follower.models.first
    frame = true_frame(tmp_path, 30.0 if by == "sight" else 0.1, seed=2)
    if by == "error":
        follower._error = 1e-12  # any error is so far above it that it tells of a cut
    if by == "size":
        cut = follower.denoise(synthetic_render(20, 30).buffers)
    else:
        cut = follower.denoise(frame.buffers, frame.camera)
    assert cut.how == "cut"
    features = ("albedo", "normal", "depth")
    assert follower.models == Models(cut.result.model, following=None, first=first, features=features)


def test_a_frame_without_noise_makes_no_cut_of_the_next_one():
    follower = Follower(DRAFT)
    card = synthetic_render(spp=10**9).buffers
    frames = [synthetic_render(seed=0).buffers, card, synthetic_render(seed=1).buffers]
    followed = [follower.denoise(frame) for frame in frames]
    assert followed[1].result.model is None
    assert [f.how for f in followed] == ["fitted", "followed", "followed"]


def test_followed_frames_obey_the_settings(tmp_path):
    frames = [true_frame(tmp_path, 0.05 * n, seed=n) for n in range(2)]
    first = Follower(DRAFT).denoise(frames[0].buffers).result.model
    follower = Follower(replace(DRAFT, target_error=10.0), models=Models(alone=first))
    assert [follower.denoise(frame.buffers).result.iterations for frame in frames] == [1, 1]
    with pytest.raises(InputError, match="fitted with preset draft, this fit is to use final"):
        Follower(FitSettings("final"), models=Models(alone=first))


def test_a_frame_that_was_cut_short_is_no_cut(tmp_path):
    frames = [true_frame(tmp_path, 0.05 * n, seed=n) for n in range(2)]
    model = Follower(DRAFT).denoise(frames[0].buffers).result.model
    follower = Follower(DRAFT, models=Models(alone=model))
    follower.denoise(frames[0].buffers)
    follower._error = 1e-12  # any error is so far above it that it tells of a cut

    def interrupt(fraction: float, message: str) -> None:
        if message.startswith("relMSE"):
            raise KeyboardInterrupt

    followed = follower.denoise(frames[1].buffers, progress=interrupt)
    assert (followed.how, followed.result.interrupted) == ("followed", True)


def test_frames_without_halves_follow_too(tmp_path):
    follower = Follower(DRAFT)
    errors = []
    for n in range(3):
        frame = true_frame(tmp_path, 0.05 * n, seed=n)
        plain = RenderBuffers(Buffer(frame.buffers.color.mean), depth=frame.buffers.depth)
        followed = follower.denoise(plain, frame.camera)
        assert (followed.how, followed.flicker) == ("followed" if n else "fitted", None)
        errors.append(relmse(followed.result.color, frame.reference))
    assert errors[2] < errors[0]


def test_frames_that_lose_a_feature_follow_again_after_one_full_fit(tmp_path):
    follower = Follower(replace(DRAFT, iterations=20))
    how = []
    for n in range(5):
        frame = true_frame(tmp_path, 0.05 * n, seed=n)
        buffers = frame.buffers if n < 2 else frame.buffers.with_quantities(normal=None)
        how.append(follower.denoise(buffers, frame.camera).how)
    assert how == ["fitted", "followed", "cut", "followed", "followed"]


@pytest.mark.parametrize("with_cameras", [True, False])
def test_frames_that_gain_features_use_them(tmp_path, with_cameras):
    follower = Follower(replace(DRAFT, iterations=20))
    how = []
    for n in range(4):
        frame = true_frame(tmp_path, 0.05 * n, seed=n)
        buffers = frame.buffers if n >= 2 else frame.buffers.with_quantities(albedo=None, normal=None)
        followed = follower.denoise(buffers, frame.camera if with_cameras else None)
        how.append(followed.how)
        assert ("normal.X" in followed.result.model.blend.layout.features) == (n >= 2)
    assert how == ["fitted", "followed", "cut", "followed"]


@pytest.mark.parametrize("with_cameras", [True, False])
@pytest.mark.parametrize("change", ["gain", "loss"])
def test_other_features_than_those_of_the_networks_are_a_cut(tmp_path, with_cameras, change):
    def buffers(n):
        frame = true_frame(tmp_path, 0.05 * n, seed=n)
        known = frame.buffers
        if (n < 2) == (change == "gain"):
            known = known.with_quantities(albedo=None)
        return known, frame.camera if with_cameras else None

    settings = replace(DRAFT, iterations=20)
    lead = Follower(settings)
    for n in range(2):
        lead.denoise(*buffers(n))
    # As a worker does that was given the networks, but not the frames that they were fitted to.
    worker = Follower(settings, models=lead.models)
    assert [worker.denoise(*buffers(n)).how for n in (2, 3)] == ["cut", "followed"]


@pytest.mark.parametrize("with_cameras", [True, False])
def test_a_black_frame_among_albedos_in_percent_is_no_cut(tmp_path, with_cameras):
    follower = Follower(replace(DRAFT, iterations=20))
    how = []
    for n in range(5):
        frame = true_frame(tmp_path, 0.05 * n, seed=n)
        percent = Buffer(100 * frame.buffers.albedo.mean)
        black = Buffer(*(np.zeros_like(plane) for _, plane in frame.buffers.color.planes()))
        color = black if n == 2 else frame.buffers.color
        buffers = frame.buffers.with_quantities(color=color, albedo=percent)
        how.append(follower.denoise(buffers, frame.camera if with_cameras else None).how)
    assert how == ["fitted", "followed", "followed", "followed", "followed"]


def test_flicker_is_not_told_by_halves_that_are_copies(tmp_path):
    follower = Follower(replace(DRAFT, iterations=5))
    for n in range(2):
        frame = true_frame(tmp_path, 0.05 * n, seed=n)
        mean = frame.buffers.color.mean
        copies = frame.buffers.with_quantities(color=Buffer(mean, mean, mean))
        followed = follower.denoise(copies, frame.camera)
        assert followed.result.halves_drawn
        assert followed.flicker is None


def test_cameras_without_depth_are_told_once(tmp_path, caplog):
    follower = Follower(replace(DRAFT, iterations=5))
    for n in range(2):
        frame = true_frame(tmp_path, 0.05 * n, seed=n)
        follower.denoise(frame.buffers.with_quantities(depth=None), frame.camera)
    assert caplog.text.count("no depth: frames cannot be moved by their cameras") == 1


def test_the_published_method_is_refused():
    with pytest.raises(InputError, match="preset paper"):
        Follower(FitSettings(preset="paper"))


@pytest.mark.filterwarnings("ignore:Specified provider")
def test_what_cannot_be_done_is_told_before_the_first_frame(tmp_path, monkeypatch):
    if "CUDAExecutionProvider" not in onnxruntime.get_available_providers():
        with pytest.raises(InputError, match="device cuda"):
            Follower(replace(DRAFT, device="cuda"))
        both = ["CUDAExecutionProvider", "CPUExecutionProvider"]
        monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: both)
        with pytest.raises(InputError, match="device cuda"):
            Follower(replace(DRAFT, device="cuda"))
    frame = true_frame(tmp_path, 0.0, seed=0)
    model = Follower(DRAFT).denoise(frame.buffers).result.model
    without = frame.buffers.with_quantities(normal=None)
    with pytest.raises(InputError, match="the model was fitted with normal"):
        Follower(DRAFT, models=Models(alone=model)).denoise(without)


def test_every_pixel_of_a_large_image_is_found():
    """7680 x 4320 pixels are more than a float32 counts."""
    column, row = np.float32([7001]), np.float32([4300])
    [index] = [index[0] for index, weight in _neighbours(column, row, 4320, 7680) if weight[0] == 1]
    assert index == 4300 * 7680 + 7001
