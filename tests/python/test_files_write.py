"""Writing results: bit-exact pass-through, reading back, and files that appear whole or not at all."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import random
import string
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio  # noqa: N813
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from synthetic import synthetic_render
from tungsten_dip.buffers import atomic, image_file
from tungsten_dip.buffers.atomic import check_writable, replacing, write_text
from tungsten_dip.buffers.image_file import MOST_HDR, write_exr, write_image
from tungsten_dip.buffers.read import read_buffers, read_image
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.buffers.source import Part
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.errors import InputError
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.fit.write import write_denoised

Channels = dict[str, np.ndarray]


def noise(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


def result_for(buffers: RenderBuffers, scale: float = 0.5, error: bool = True) -> FitResult:
    shape = buffers.color.mean.shape
    return FitResult(
        color=scale * noise(shape, 77),
        settings=FitSettings(seed=12, preset="draft"),
        seconds=1.5,
        iterations=40,
        error=noise((*shape[:2], 1), 78) if error else None,
        estimated_relmse=0.25 if error else None,
    )


def save(path: Path, parts: dict[str, Channels], **header: object) -> None:
    encoded = [
        OpenEXR.Part(
            {"type": OpenEXR.scanlineimage, **header}, {n: c.copy() for n, c in channels.items()}, name
        )
        for name, channels in parts.items()
    ]
    OpenEXR.File(encoded).write(str(path))


def load(path: Path) -> list[tuple[str, Channels, dict[str, object]]]:
    """Read with OpenEXR alone, independent of our reader."""
    parts = OpenEXR.File(str(path), separate_channels=True).parts
    return [(p.name(), {n: c.pixels for n, c in p.channels.items()}, dict(p.header)) for p in parts]


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def assert_same(a: RenderBuffers, b: RenderBuffers) -> None:
    assert [name for name, _ in a.quantities()] == [name for name, _ in b.quantities()]
    for (name, x), (_, y) in zip(a.quantities(), b.quantities(), strict=True):
        assert [plane for plane, _ in x.planes()] == [plane for plane, _ in y.planes()]
        for (plane, p), (_, q) in zip(x.planes(), y.planes(), strict=True):
            assert same_bits(p, q), (name, plane)
    assert (a.alpha is None) == (b.alpha is None)
    assert a.alpha is None or same_bits(a.alpha, b.alpha)
    if isinstance(a.spp, np.ndarray):
        assert same_bits(a.spp, b.spp)
    else:
        assert a.spp == b.spp
    assert a.attributes.keys() == b.attributes.keys()


HALF_WITH_NAN_BITS = np.array([[0x7C01, 0x7E55, 0xFE00], [0x7C00, 0x8000, 0x0001]], np.uint16).view(
    np.float16
)
"""Signalling and quiet NaN, infinity, -0 and a subnormal: nothing that survives a conversion by chance."""


def mixed_channels() -> Channels:
    return {
        **dict.fromkeys("RGBA", HALF_WITH_NAN_BITS),
        **{f"albedo.{name}": noise((2, 3), index) for index, name in enumerate("RGB")},
        "object.id": np.array([[0, 2**32 - 1, 2**31], [3, 4, 5]], np.uint32),
        "P.X": HALF_WITH_NAN_BITS,
        "error.Y": noise((2, 3), 9),
    }


def test_writing_leaves_no_threads_behind(tmp_path: Path) -> None:
    """A process that forks later must have none."""
    before = OpenEXR.global_thread_count()
    write_exr(tmp_path / "a.exr", [Part({"R": noise((64, 64))})], threads=before + 2)
    assert OpenEXR.global_thread_count() == before


def test_writers_at_once_leave_no_threads_behind() -> None:
    before = OpenEXR.global_thread_count()
    second_began, first_ended = Event(), Event()

    def second() -> None:
        with image_file._compressing(before + 2):
            second_began.set()
            first_ended.wait()

    thread = Thread(target=second)
    with image_file._compressing(before + 2):
        thread.start()
        second_began.wait(0.2)  # in vain: it waits for the first
    first_ended.set()
    thread.join()
    assert OpenEXR.global_thread_count() == before


def test_everything_of_the_input_passes_through_bit_for_bit(tmp_path: Path) -> None:
    channels = mixed_channels()
    window = np.array([-4, 2], "i"), np.array([-2, 3], "i")
    display = np.array([0, 0], "i"), np.array([9, 9], "i")
    attributes = {
        "owner": "somebody",
        "worldToCamera": np.eye(4, dtype="f"),
        "exposure": 2.5,
        "samplesPerPixel": 8,
        "views": ["a", "b"],
        "pixelAspectRatio": 1.5,
    }
    save(tmp_path / "in.exr", {"": channels}, dataWindow=window, displayWindow=display, **attributes)
    buffers = read_buffers(tmp_path / "in.exr")
    result = result_for(buffers)
    write_denoised(tmp_path / "out.exr", result, buffers)
    [(_, written, header)] = load(tmp_path / "out.exr")
    for index, name in enumerate("RGB"):
        assert same_bits(written[name], result.color[..., index].copy())
    assert same_bits(written["error.Y"], result.error[..., 0].copy())
    for name, channel in channels.items():
        moved = f"noisy.{name}" if name in {*"RGBA", "error.Y"} else name
        assert same_bits(written[moved], channel), name
    replaced = {*"RGBA", "error.Y"}
    assert written.keys() == replaced | {f"noisy.{name}" for name in replaced} | channels.keys()
    assert np.array_equal(header["dataWindow"], window)
    assert np.array_equal(header["displayWindow"], display)
    for name, value in attributes.items():
        assert np.array_equal(header[name], value), name
    assert header["tungsten_dip/seed"] == "12"
    assert header["tungsten_dip/seconds"] == 1.5
    assert header["tungsten_dip/iterations"] == 40
    assert header["tungsten_dip/estimated_relmse"] == 0.25
    assert json.loads(header["tungsten_dip/settings"])["preset"] == "draft"
    assert header["tungsten_dip/version"]

    again = read_buffers(tmp_path / "out.exr")
    assert_same(buffers, again)
    assert np.array_equal(read_image(tmp_path / "out.exr"), result.color)
    write_denoised(tmp_path / "out.exr", result, again)  # onto its own input
    assert load(tmp_path / "out.exr")[0][1].keys() == written.keys()
    assert_same(buffers, read_buffers(tmp_path / "out.exr"))


@pytest.mark.parametrize("damaged", [False, True])
def test_the_pictures_alpha_is_finite_and_the_inputs_as_it_was(tmp_path: Path, damaged: bool) -> None:
    alpha = np.array([[-0.05, 0.5, 1.25], [0, 1, 0.75]], np.float16)  # with a filter's lobes
    if damaged:
        alpha[0, 1], alpha[1, 2] = np.nan, np.inf
    save(tmp_path / "in.exr", {"": {**{name: noise((2, 3), 1) for name in "RGB"}, "A": alpha}})
    buffers = read_buffers(tmp_path / "in.exr")
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    [(_, written, _)] = load(tmp_path / "out.exr")
    assert same_bits(written["noisy.A" if damaged else "A"], alpha)
    assert np.isfinite(written["A"]).all()
    sane = np.isfinite(alpha)
    assert np.array_equal(written["A"][sane], alpha[sane])
    assert ("noisy.A" in written) == damaged
    assert_same(buffers, read_buffers(tmp_path / "out.exr"))


def test_the_pictures_place_is_that_of_the_colours_part(tmp_path: Path) -> None:
    display = {"displayWindow": ((0, 0), (9, 9))}
    window = {"dataWindow": ((5, 7), (7, 8)), **display}
    pixels = {channel: noise((2, 3), 1) for channel in "RGB"}
    other = {"id": noise((4, 4), 2)}
    encoded = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage, **display}, other, "mattes"),
        OpenEXR.Part({"type": OpenEXR.scanlineimage, "samplesPerPixel": 64, **window}, pixels, "color"),
    ]
    OpenEXR.File(encoded).write(str(tmp_path / "in.exr"))
    buffers = read_buffers(tmp_path / "in.exr")
    assert buffers.spp == 64
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    for _ in range(2):
        (_, channels, header), (mattes, _, _), _ = load(tmp_path / "out.exr")
        assert channels["R"].shape == (2, 3)
        assert np.array_equal(header["dataWindow"], window["dataWindow"])
        assert mattes == "mattes"
        again = read_buffers(tmp_path / "out.exr")
        assert again.spp == 64
        write_denoised(tmp_path / "out.exr", result_for(again), again)


def test_the_output_does_not_claim_to_be_an_aces_container(tmp_path: Path) -> None:
    pixels = dict.fromkeys("RGB", noise((2, 3)).astype(np.float16))
    save(tmp_path / "in.exr", {"": pixels}, acesImageContainerFlag=1, owner="somebody")
    buffers = read_buffers(tmp_path / "in.exr")
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    [(_, _, header)] = load(tmp_path / "out.exr")
    assert header["owner"] == "somebody"
    assert "acesImageContainerFlag" not in header


def test_what_openexr_cannot_write_is_one_line(tmp_path: Path) -> None:
    part = Part({"R": noise((2, 3), 1)}, {"dataWindow": ((0, 0), (7, 7))})
    with pytest.raises(InputError, match=r"out\.exr: OpenEXR cannot write this \(") as caught:
        write_exr(tmp_path / "out.exr", [part])
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_parts_pass_through(tmp_path: Path) -> None:
    parts = {
        "rgba": dict.fromkeys("RGBA", HALF_WITH_NAN_BITS),
        "N": {name: noise((2, 3), index) for index, name in enumerate("XYZ")},
        "id": {"id": np.arange(6, dtype=np.uint32).reshape(2, 3)},
    }
    save(tmp_path / "in.exr", parts, note="kept")
    buffers = read_buffers(tmp_path / "in.exr")
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    for _ in range(2):
        first, *others = load(tmp_path / "out.exr")
        assert first[1].keys() == {*"RGBA", "error.Y"}
        assert np.isfinite(first[1]["A"]).all()
        assert [name for name, _, _ in others] == list(parts)
        for name, channels, header in others:
            assert channels.keys() == parts[name].keys()
            assert all(same_bits(channels[key], parts[name][key]) for key in channels)
            assert header["note"] == "kept"
        again = read_buffers(tmp_path / "out.exr")
        assert_same(buffers, again)
        write_denoised(tmp_path / "out.exr", result_for(again, error=True), again)


@pytest.mark.parametrize("name", ["cafe.id", "cafe"])
def test_names_that_are_no_utf8_are_renamed_and_told(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    rgb, other = {channel: noise((2, 3), index) for index, channel in enumerate("RGB")}, noise((2, 3), 3)
    in_layer = "." in name
    parts = {"": {**rgb, name: other}} if in_layer else {"rgba": rgb, name: {"id": other}}
    save(tmp_path / "in.exr", parts)
    content = (tmp_path / "in.exr").read_bytes()
    (tmp_path / "in.exr").write_bytes(content.replace(b"cafe", b"caf\xe9"))
    buffers = read_buffers(tmp_path / "in.exr")
    renamed = name.replace("cafe", r"caf\xe9")
    assert f"in.exr: expected names in UTF-8: renamed {renamed}" in caplog.text
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    written = load(tmp_path / "out.exr")
    channels = written[0][1] if in_layer else {part: channels["id"] for part, channels, _ in written[2:]}
    assert same_bits(channels[renamed], other)


def test_no_channel_of_the_noisy_picture_stays_beside_the_denoised_one(tmp_path: Path) -> None:
    for names in ("rgba", "Y", "RGBA"):
        save(tmp_path / "in.exr", {"": {name: noise((3, 2), index) for index, name in enumerate(names)}})
        buffers = read_buffers(tmp_path / "in.exr")
        write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
        [(_, written, _)] = load(tmp_path / "out.exr")
        top = {name for name in written if "." not in name}
        assert top == ({*"RGB"} if names == "Y" else {*"RGBA"})
        assert_same(buffers, read_buffers(tmp_path / "out.exr"))


def test_what_was_changed_since_is_written_as_it_is_now(tmp_path: Path) -> None:
    save(tmp_path / "in.exr", {"": {name: noise((3, 2), index) for index, name in enumerate("RGBZ")}})
    buffers = read_buffers(tmp_path / "in.exr")
    changed = buffers.with_quantities(color=Buffer(2 * buffers.color.mean), depth=None)
    write_denoised(tmp_path / "out.exr", result_for(changed), changed)
    again = read_buffers(tmp_path / "out.exr")
    assert same_bits(again.color.mean, 2 * buffers.color.mean)
    assert again.depth is None


@pytest.mark.parametrize("changed", ["color", "depth", "alpha"])
def test_images_replaced_after_reading_are_those_written(tmp_path: Path, changed: str) -> None:
    names = [*"RGBA", "depth.Y", "id"]
    save(tmp_path / "in.exr", {"": {name: noise((3, 2), index) for index, name in enumerate(names)}})
    buffers = read_buffers(tmp_path / "in.exr")
    other = noise((3, 2, 3 if changed == "color" else 1), 9)
    changes: dict[str, Any] = {changed: other if changed == "alpha" else Buffer(other)}
    now = replace(buffers, **changes)
    write_denoised(tmp_path / "out.exr", result_for(now), now)
    assert_same(now, read_buffers(tmp_path / "out.exr"))
    # What is no image leaves the file's other layers where they are.
    assert replace(buffers, attributes={"owner": "somebody"}).source is buffers.source


@pytest.mark.parametrize("stored", ["a layer", "an attribute", "nowhere"])
@pytest.mark.parametrize("now", ["varies", 32.0])
def test_samples_replaced_after_reading_are_those_written(tmp_path: Path, stored: str, now: object) -> None:
    names = [*"RGB", "Variance.R", "Variance.G", "Variance.B", *(["spp.Y"] if stored == "a layer" else [])]
    header = {"samplesPerPixel": 16} if stored == "an attribute" else {}
    channels = {name: noise((3, 2), index) for index, name in enumerate(names)}
    save(tmp_path / "in.exr", {"": channels}, **header)
    buffers = read_buffers(tmp_path / "in.exr")
    changed = replace(buffers, spp=noise((3, 2, 1), 9) if now == "varies" else now)
    write_denoised(tmp_path / "out.exr", result_for(changed), changed)
    assert_same(changed, read_buffers(tmp_path / "out.exr"))
    if isinstance(buffers.spp, float):
        assert replace(buffers, spp=float(buffers.spp)).source is buffers.source


def test_a_result_of_other_buffers_or_another_name_is_refused(tmp_path: Path) -> None:
    for name, size in (("in", (3, 2)), ("other", (3, 3))):
        save(tmp_path / f"{name}.exr", {"": {channel: noise(size) for channel in "RGB"}})
    buffers, other = (read_buffers(tmp_path / f"{name}.exr") for name in ("in", "other"))
    with pytest.raises(InputError, match="made from"):
        write_denoised(tmp_path / "out.exr", result_for(other), buffers)
    with pytest.raises(InputError, match="made from"):
        write_denoised(
            tmp_path / "out.exr", replace(result_for(buffers), error=result_for(other).error), buffers
        )
    with pytest.raises(InputError, match="buffers: expected RenderBuffers, got NoneType; give those"):
        write_denoised(tmp_path / "out.exr", result_for(buffers), None)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="result: expected FitResult, got ndarray; give what denoise"):
        write_denoised(tmp_path / "out.exr", result_for(buffers).color, buffers)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"ends in \.exr"):
        write_denoised(tmp_path / "out.png", result_for(buffers), buffers)
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.int32, np.uint8])
def test_a_result_may_be_graded_in_another_type(tmp_path: Path, dtype: type) -> None:
    buffers = RenderBuffers(Buffer(noise((3, 2, 3))))
    result = result_for(buffers)
    graded = replace(result, color=(5 * result.color).astype(dtype), error=result.error.astype(dtype))
    write_denoised(tmp_path / "out.exr", graded, buffers)
    [(_, written, _)] = load(tmp_path / "out.exr")
    for index, name in enumerate("RGB"):
        assert same_bits(written[name], graded.color[..., index].astype(np.float32))
    assert same_bits(written["error.Y"], graded.error[..., 0].astype(np.float32))


def test_the_map_is_remembered(tmp_path: Path) -> None:
    names = [*"RGB", "main.R", "main.G", "main.B", "nx", "ny", "nz"]
    save(tmp_path / "in.exr", {"": {name: noise((3, 2), index) for index, name in enumerate(names)}})
    buffers = read_buffers(tmp_path / "in.exr", {"color": "main", "normal": "nx,ny,nz"})
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    assert_same(buffers, read_buffers(tmp_path / "out.exr"))
    other = read_buffers(tmp_path / "out.exr", {"color": "R,G,B"})
    assert same_bits(other.color.mean, read_buffers(tmp_path / "in.exr").color.mean)
    assert same_bits(other.normal.mean, buffers.normal.mean)


def test_what_the_map_gives_for_a_mean_replaces_what_is_remembered_of_it(tmp_path: Path) -> None:
    names = [*"RGB", *(f"{layer}.{c}" for layer in ("a", "first", "second") for c in "RGB"), "nx", "ny", "nz"]
    save(tmp_path / "in.exr", {"": {name: noise((3, 2), index) for index, name in enumerate(names)}})
    mapping = {"albedo": "a", "albedoA": "first", "albedoB": "second", "normal": "nx,ny,nz"}
    buffers = read_buffers(tmp_path / "in.exr", mapping)
    assert buffers.albedo.halves is not None
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    without = read_buffers(tmp_path / "out.exr", {"albedo": "none"})
    assert without.albedo is None
    assert same_bits(without.normal.mean, buffers.normal.mean)
    one_half = read_buffers(tmp_path / "out.exr", {"albedoA": "none"}).albedo
    assert same_bits(one_half.mean, buffers.albedo.mean)
    assert one_half.half_a is None
    assert same_bits(one_half.half_b, buffers.albedo.half_b)


@pytest.mark.parametrize("kept", [["R", "G", "B"], ["R", "G", "B", "albedo.R", "albedo.G", "albedo.B"]])
def test_a_denoised_picture_without_its_noisy_one_is_a_picture(
    tmp_path: Path, kept: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    albedo = {f"albedo.{channel}": noise((3, 2), 1) for channel in "RGB"}
    save(tmp_path / "in.exr", {"": {channel: noise((3, 2)) for channel in "RGB"} | albedo})
    buffers = read_buffers(tmp_path / "in.exr")
    result = result_for(buffers)
    write_denoised(tmp_path / "out.exr", result, buffers)
    [(_, channels, header)] = load(tmp_path / "out.exr")
    # As oiiotool --ch does: the attributes stay.
    write_exr(tmp_path / "rgb.exr", [Part({name: channels[name] for name in kept}, header)])
    again = read_buffers(tmp_path / "rgb.exr")
    assert same_bits(again.color.mean, result.color)
    assert (again.albedo is None) == ("albedo.R" not in kept)
    assert "no longer" in caplog.text
    write_denoised(tmp_path / "rgb_denoised.exr", result, again)
    assert_same(again, read_buffers(tmp_path / "rgb_denoised.exr"))


def test_a_denoised_file_of_several_parts_without_the_noisy_one_is_denoised_again(tmp_path: Path) -> None:
    parts = {"rgba": {channel: noise((3, 2)) for channel in "RGB"}, "id": {"id": noise((3, 2), 1)}}
    save(tmp_path / "in.exr", parts)
    buffers = read_buffers(tmp_path / "in.exr")
    result = result_for(buffers)
    write_denoised(tmp_path / "out.exr", result, buffers)
    denoised, _, ids = (Part(channels, header, name) for name, channels, header in load(tmp_path / "out.exr"))
    write_exr(tmp_path / "kept.exr", [denoised, ids])
    again = read_buffers(tmp_path / "kept.exr")
    assert same_bits(again.color.mean, result.color)
    write_denoised(tmp_path / "again.exr", result_for(again, scale=0.25), again)
    assert_same(again, read_buffers(tmp_path / "again.exr"))


@pytest.mark.parametrize("names", ["Y", "RGB"])
def test_a_denoised_picture_without_its_attributes_is_read_as_the_noisy_one(
    tmp_path: Path, names: str
) -> None:
    save(tmp_path / "in.exr", {"": {name: noise((3, 2), index) for index, name in enumerate(names)}})
    buffers = read_buffers(tmp_path / "in.exr")
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    [(name, channels, _)] = load(tmp_path / "out.exr")
    save(tmp_path / "bare.exr", {name: channels})
    assert same_bits(read_buffers(tmp_path / "bare.exr").color.mean, buffers.color.mean)


@pytest.mark.parametrize("mapping", ["[" * 100_000, "[]", "{"])
def test_a_denoised_file_with_damaged_attributes_is_refused(tmp_path: Path, mapping: str) -> None:
    save(tmp_path / "in.exr", {"": {name: noise((3, 2)) for name in "RGB"}})
    buffers = read_buffers(tmp_path / "in.exr")
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    [(_, channels, header)] = load(tmp_path / "out.exr")
    write_exr(tmp_path / "out.exr", [Part(channels, {**header, "tungsten_dip/map": mapping})])
    with pytest.raises(InputError, match="denoise the original input again"):
        read_buffers(tmp_path / "out.exr")


def test_a_folder_travels_in_half(tmp_path: Path) -> None:
    for key, names in (("color", "RGB"), ("colorVariance", "RGB"), ("depth", "Y")):
        save(tmp_path / f"{key}.exr", {"": dict.fromkeys(names, HALF_WITH_NAN_BITS)})
    buffers = read_buffers(tmp_path)
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    [(_, written, _)] = load(tmp_path / "out.exr")
    assert {"color.R", "colorVariance.B", "depth.Y"} <= written.keys()
    assert all(
        same_bits(written[name], HALF_WITH_NAN_BITS) for name in ("color.R", "colorVariance.B", "depth.Y")
    )
    assert_same(buffers, read_buffers(tmp_path / "out.exr"))


def test_a_denoised_folder_whose_feature_another_tool_has_removed_is_read_without_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for key, seed in (("color", 0), ("albedo", 1)):
        save(tmp_path / f"{key}.exr", {"": {channel: noise((2, 3), seed) for channel in "RGB"}})
    buffers = read_buffers(tmp_path)
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    [(_, channels, header)] = load(tmp_path / "out.exr")
    kept = {name: channel for name, channel in channels.items() if not name.startswith("albedo")}
    write_exr(tmp_path / "kept.exr", [Part(kept, header)])
    again = read_buffers(tmp_path / "kept.exr")
    assert same_bits(again.color.mean, buffers.color.mean)
    assert again.albedo is None
    assert "no longer" not in caplog.text


def test_layers_and_parts_of_the_files_of_a_folder_travel_by_their_names(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def layer(name: str, seed: int) -> Channels:
        return {f"{name}{component}": noise((2, 3), seed + index) for index, component in enumerate("RGB")}

    color = {**layer("", 0), **layer("crypto00.", 3), **layer("Denoising Albedo.", 6), "id": noise((2, 3), 9)}
    parts = {
        "rgba": color,
        "crypto01": layer("", 20),
        "light": layer("light.", 30),
        "noisy": layer("", 60),
        "far": {name: noise((4, 4)) for name in "RGB"},
    }
    window = {"displayWindow": ((0, 0), (9, 9))}  # those of the parts must agree
    save(tmp_path / "color.exr", parts, **{"cryptomatte/1/name": "crypto"}, **window)
    save(tmp_path / "albedo.exr", {"": {**layer("", 40), **layer("crypto00.", 50)}})
    with caplog.at_level(logging.INFO):
        buffers = read_buffers(tmp_path)
    assert "ignored: color.exr: far, of another size" in caplog.text
    assert same_bits(buffers.color.mean, np.stack([color[name] for name in "RGB"], axis=-1))
    assert same_bits(buffers.albedo.mean, np.stack(list(layer("", 40).values()), axis=-1))
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    [(_, written, header)] = load(tmp_path / "out.exr")
    expected = {
        **layer("color.", 0),
        "color.id": color["id"],
        **layer("color.Denoising Albedo.", 6),
        **layer("crypto00.", 3),
        **layer("crypto01.", 20),
        **layer("light.", 30),
        **layer("color.noisy.", 60),
        **layer("albedo.", 40),
        **layer("albedo.crypto00.", 50),
    }
    assert written.keys() == expected.keys() | {*"RGB", "error.Y"}
    assert all(same_bits(written[name], channel) for name, channel in expected.items())
    assert header["cryptomatte/1/name"] == "crypto"
    assert_same(buffers, read_buffers(tmp_path / "out.exr"))


@pytest.mark.parametrize("size", [(1, 1), (1, 8), (13, 7)])
@pytest.mark.parametrize("spp", [None, 16.0, "varies"])
def test_buffers_of_a_host_become_layers(tmp_path: Path, size: tuple[int, int], spp: object) -> None:
    per_pixel = noise((*size, 1)) if spp == "varies" else spp
    buffers = synthetic_render(height=size[0], width=size[1]).buffers
    buffers = RenderBuffers(
        **dict(buffers.quantities()), spp=per_pixel, alpha=noise((*size, 1), 3), attributes={"host": "a test"}
    )
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    [(_, written, header)] = load(tmp_path / "out.exr")
    assert {*"RGBA", "color.R", "colorA.R", "normal.X", "depth.Y", "error.Y"} <= written.keys()
    assert header["host"] == "a test"
    assert_same(buffers, read_buffers(tmp_path / "out.exr"))
    write_tungsten_folder(tmp_path / "folder", buffers)
    assert (tmp_path / "folder" / "colorVariance.exr").is_file()
    assert_same(buffers, read_buffers(tmp_path / "folder"))


@pytest.mark.parametrize("key", ["color", "albedo", "colorVariance"])
def test_a_denoised_image_is_not_read_as_a_file_of_a_folder_or_a_scene(tmp_path: Path, key: str) -> None:
    for name in ("color", "albedo", "colorVariance"):
        write_image(tmp_path / f"{name}.pfm", noise((2, 3, 3)))
    requests = [
        {"type": "color", "hdr_output_file": "color.exr", "sample_variance": True},
        {"type": "albedo", "hdr_output_file": "albedo.exr"},
    ]
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps({"renderer": {"output_buffers": requests}}))
    buffers = read_buffers(tmp_path)
    for name in ("color", "albedo", "colorVariance"):
        write_image(tmp_path / f"{name}.exr", noise((2, 3, 3)))
    read_buffers(scene)
    denoised = tmp_path / f"{key}.exr"
    write_denoised(denoised, result_for(buffers), buffers)
    for path, mapping in ((tmp_path, {}), (tmp_path, {key: denoised.name}), (scene, {})):
        with pytest.raises(InputError, match=f"{key}.exr: expected what was rendered, found a denoised"):
            read_buffers(path, mapping)
    assert_same(buffers, read_buffers(denoised))
    assert_same(buffers, read_buffers(tmp_path, {key: f"{key}.pfm"}))


def test_a_folder_of_another_render_is_not_mixed_in(tmp_path: Path) -> None:
    buffers = synthetic_render(height=3, width=4).buffers
    write_tungsten_folder(tmp_path, buffers)
    write_tungsten_folder(tmp_path, buffers)
    with pytest.raises(InputError, match=r"holds .* of another render; remove it"):
        write_tungsten_folder(tmp_path, RenderBuffers(buffers.color))
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        write_tungsten_folder(tmp_path / "file", buffers)


@pytest.mark.parametrize("scale", [1e-8, 1e6])
def test_half_never_turns_into_infinity_or_black(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, scale: float
) -> None:
    buffers = RenderBuffers(Buffer(noise((2, 3, 3))))
    fits, other = result_for(buffers), result_for(buffers, scale)
    fits.color[0, 0] = np.inf, 65504, np.nan
    fits.color[0, 1] = 0, 1e-9, -1e-9
    write_denoised(tmp_path / "a.exr", fits, buffers, float16=True)
    channels = load(tmp_path / "a.exr")[0][1]
    assert channels["R"].dtype == channels["error.Y"].dtype == np.float16
    assert channels["G"][0, 0] == 65504
    assert channels["color.R"].dtype == np.float32
    assert not caplog.text
    write_denoised(tmp_path / "a.exr", other, buffers, float16=True)
    channels = load(tmp_path / "a.exr")[0][1]
    assert same_bits(channels["R"], other.color[..., 0].copy())
    assert channels["error.Y"].dtype == np.float16
    assert "the picture has values that half floats cannot hold (beyond 65504" in caplog.text
    caplog.clear()
    fits.error[0, 0] = 1e6
    write_denoised(tmp_path / "a.exr", fits, buffers, float16=True)
    assert load(tmp_path / "a.exr")[0][1]["error.Y"].dtype == np.float32
    assert "the error has values that half floats cannot hold (beyond 65504" in caplog.text


def test_attributes_that_exr_cannot_hold_do_not_cost_the_result(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    attributes = {
        "good": "yes",
        "rational": OpenEXR.Rational(1, 2),
        "nested": {"a": 1},
        "type": 3,
        "channels": "x",
    }
    buffers = RenderBuffers(Buffer(noise((2, 3, 3))), attributes=attributes)
    with caplog.at_level(logging.WARNING):
        write_denoised(tmp_path / "a.exr", result_for(buffers, error=False), buffers)
    header = load(tmp_path / "a.exr")[0][2]
    assert header["good"] == "yes"
    assert "error.Y" not in load(tmp_path / "a.exr")[0][1]
    assert "rational" in caplog.text
    assert "nested" in caplog.text


@pytest.mark.parametrize("value", [[1, 2], [True], [[1.0]], 10**12, -(2**31) - 1])
def test_attributes_that_openexr_would_change_are_left_out_and_told(
    tmp_path: Path, value: object, caplog: pytest.LogCaptureFixture
) -> None:
    kept = {"list": [1.5, 2.5], "words": ["a", "b"], "pair": (1, 2), "int": 2**31 - 1, "float": 0.5}
    write_exr(tmp_path / "a.exr", [Part({"Y": noise((2, 3))}, {**kept, "bad": value})])
    header = load(tmp_path / "a.exr")[0][2]
    assert "bad" not in header
    assert "attribute bad is left out: expected an integer of 32 bits, or a list" in caplog.text
    for name, expected in kept.items():
        assert np.array_equal(header[name], expected), name


NAME = st.sampled_from(
    ["R", "G", "B", "A", "Y", "Z", "noisy.R", "noisy.G", "noisy_.B", "error.Y", "error", "N.X"]
)
OTHER = st.text(string.ascii_letters + string.digits + "._ ", min_size=1, max_size=8)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(names=["R", "r"], types=random.Random(0))
@given(names=st.lists(NAME | OTHER, max_size=10, unique=True), types=st.randoms(use_true_random=False))
def test_any_channel_names_survive(tmp_path: Path, names: list[str], types: object) -> None:
    names = list(dict.fromkeys([*names, "beauty.R", "beauty.G", "beauty.B"]))
    dtypes = [types.choice([np.float16, np.float32, np.uint32]) for _ in names]
    channels = {
        name: (1000 * noise((1, 2), index)).astype(dtype)
        for index, (name, dtype) in enumerate(zip(names, dtypes, strict=True))
    }
    save(tmp_path / "in.exr", {"": channels})
    try:
        buffers = read_buffers(tmp_path / "in.exr")
    except InputError:  # such as a depth of three different channels
        assume(False)
    write_denoised(tmp_path / "out.exr", result_for(buffers), buffers)
    again = read_buffers(tmp_path / "out.exr")
    assert_same(buffers, again)
    restored = again.source.parts[0].channels
    assert restored.keys() == channels.keys()
    assert all(same_bits(restored[name], channels[name]) for name in channels)


# Single pictures


@pytest.mark.parametrize("size", [(1, 1), (5, 8), (9, 1)])
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("suffix", [".exr", ".pfm", ".hdr", ".png"])
def test_single_pictures(tmp_path: Path, size: tuple[int, int], count: int, suffix: str) -> None:
    image = noise((*size, count))
    write_image(tmp_path / f"a{suffix}", image)
    if suffix == ".png":
        stored = oiio.ImageInput.open(str(tmp_path / "a.png")).read_image("float")
    else:
        stored = read_image(tmp_path / f"a{suffix}")
    tolerance = {".png": 0.5 / 255 + 1e-6, ".hdr": 1 / 128}.get(suffix, 0)
    assert np.abs(stored - image).max() <= tolerance


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int64])
def test_integers_are_no_values_from_0_to_1(tmp_path: Path, dtype: type) -> None:
    image = np.arange(18).reshape(2, 3, 3).astype(dtype)
    with pytest.raises(InputError, match=rf"expected values from 0 to 1, got {dtype.__name__}; divide by"):
        write_image(tmp_path / "a.png", image)
    write_image(tmp_path / "a.png", image > 8)
    np.testing.assert_array_equal(oiio.ImageBuf(str(tmp_path / "a.png")).get_pixels() == 1, image > 8)
    write_image(tmp_path / "a.exr", image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), image)


def test_png_clips_and_rounds(tmp_path: Path) -> None:
    values = np.array([-1, 0, 0.499 / 255, 0.501 / 255, 1, 7], np.float32)
    write_image(tmp_path / "a.png", values.reshape(1, 6, 1))
    stored = oiio.ImageInput.open(str(tmp_path / "a.png")).read_image("uint8")
    assert stored.ravel().tolist() == [0, 0, 0, 1, 255, 255]


@pytest.mark.parametrize("value", [-0.5, np.inf, np.nan, 2.0**127])
def test_values_that_a_hdr_would_lose_are_refused(tmp_path: Path, value: float) -> None:
    image = noise((3, 2, 3))
    image[1, 1, 1] = value
    with pytest.raises(
        InputError, match=r"a\.hdr: expected values from 0 to 1.7e\+38, .*; use \.exr or \.pfm"
    ):
        write_image(tmp_path / "a.hdr", image)
    for suffix in (".exr", ".pfm"):
        write_image(tmp_path / f"a{suffix}", image)
        assert np.array_equal(read_image(tmp_path / f"a{suffix}"), image, equal_nan=True)


def test_a_hdr_holds_its_largest_value(tmp_path: Path) -> None:
    write_image(tmp_path / "a.hdr", np.full((3, 2, 3), MOST_HDR))
    np.testing.assert_allclose(read_image(tmp_path / "a.hdr"), MOST_HDR, rtol=1 / 128)


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".pfm", ".png"])
def test_values_beyond_float32_are_refused(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match=r"expected values up to 3e38 \(float32\), got larger ones; scale"):
        write_image(tmp_path / f"a{suffix}", np.full((3, 4, 3), 1e300))
    assert not list(tmp_path.iterdir())


def test_pfm_is_stored_bottom_up(tmp_path: Path) -> None:
    image = noise((3, 2, 3))
    write_image(tmp_path / "a.pfm", image)
    data = (tmp_path / "a.pfm").read_bytes()[-image.nbytes :]
    assert np.array_equal(np.frombuffer(data, "<f4").reshape(image.shape), image[::-1])


# Whole or not at all


@pytest.mark.parametrize("suffix", [".exr", ".pfm", ".hdr", ".png"])
def test_a_full_disk_leaves_the_old_file(tmp_path: Path, suffix: str) -> None:
    """A child process may write files of at most 3000 bytes: writing fails there as on a full disk."""
    old = tmp_path / f"old{suffix}"
    old.write_bytes(b"old")
    script = """
import resource, sys
from pathlib import Path
import numpy as np
from tungsten_dip.buffers.image_file import write_image
from tungsten_dip.errors import InputError

resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
image = np.random.default_rng(0).random((64, 64, 3), dtype=np.float32)
refused = 0
for name in sys.argv[1:]:
    try:
        write_image(name, image)
    except InputError as error:
        assert name in str(error) and "\\n" not in str(error), error
        refused += 1
sys.exit(refused)
"""
    names = [str(old), str(tmp_path / f"new{suffix}")]
    child = subprocess.run(
        [sys.executable, "-c", script, *names], capture_output=True, text=True, timeout=120, check=False
    )
    assert (child.returncode, child.stdout, child.stderr) == (2, "", "")
    assert [file.name for file in tmp_path.iterdir()] == [old.name]
    assert old.read_bytes() == b"old"


def test_an_exception_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail(failure: type[BaseException]) -> None:
        with replacing(path) as temporary:
            assert temporary.suffix == ".txt"
            temporary.write_text("half")
            raise failure

    for failure in (RuntimeError, KeyboardInterrupt):
        with pytest.raises(failure):
            fail(failure)
    assert [file.read_text() for file in tmp_path.iterdir()] == ["old"]
    with replacing(path) as temporary:
        temporary.write_text("new")
    assert [file.read_text() for file in tmp_path.iterdir()] == ["new"]


def test_a_file_that_another_process_takes_for_one_left_by_the_dead_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = fcntl.flock
    raced = []

    def late(file: Any, flags: int) -> None:
        if not raced:
            raced.append(file)
            atomic._remove_left_by_the_dead(tmp_path / "a.txt")
        lock(file, flags)

    monkeypatch.setattr(fcntl, "flock", late)
    with replacing(tmp_path / "a.txt") as temporary:
        assert raced
        assert temporary.exists()
        temporary.write_text("whole")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["whole"]


def test_hidden_files_of_the_user_stay(tmp_path: Path) -> None:
    for name in (".kitchen-20261129.exr", ".kitchen-0badcafe.exr"):
        (tmp_path / name).write_text("of the user")
    write_image(tmp_path / "kitchen.exr", noise((2, 3, 3)))
    assert len(list(tmp_path.iterdir())) == 3


def test_a_check_whose_file_another_process_removes_succeeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unlink = Path.unlink

    def late(path: Path, missing_ok: bool = False) -> None:
        path.rename(tmp_path / "gone")
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", late)
    check_writable(tmp_path / "a.exr", ".exr")


@pytest.mark.parametrize("letter", ["a", "\u00e9"])
def test_names_may_be_as_long_as_the_file_system_lets_them(tmp_path: Path, letter: str) -> None:
    longest = 255 - len(".exr")
    path = tmp_path / f"{letter * (longest // len(letter.encode()))}.exr"
    check_writable(path, ".exr")
    for seed in range(2):
        begin = letter * 100 if letter.isascii() else ""
        (tmp_path / f".{begin}-01234567.tungsten-dip.exr").write_text("old")
        write_image(path, noise((2, 3, 3), seed))
        assert list(tmp_path.iterdir()) == [path]
        assert np.array_equal(read_image(path), noise((2, 3, 3), seed))


def test_a_name_that_is_no_text_is_escaped_in_a_text(tmp_path: Path) -> None:
    write_text(tmp_path / "page.html", os.fsdecode(b"<h1>K\xfcche</h1>"))
    assert (tmp_path / "page.html").read_text() == r"<h1>K\udcfcche</h1>"


def test_a_link_stays_a_link_and_the_umask_holds(tmp_path: Path) -> None:
    (tmp_path / "link.exr").symlink_to(tmp_path / "target.exr")
    write_image(tmp_path / "link.exr", noise((2, 2, 3)))
    assert (tmp_path / "link.exr").is_symlink()
    umask = os.umask(0)
    os.umask(umask)
    assert (tmp_path / "target.exr").stat().st_mode & 0o777 == 0o666 & ~umask


def test_what_cannot_be_written_is_known_before(tmp_path: Path) -> None:
    check_writable(tmp_path / "a.exr", ".exr")
    check_writable(tmp_path / "a.EXR", ".exr")
    check_writable(tmp_path / "a.html", ".html")
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "file").touch()
    before = sorted(tmp_path.iterdir())
    for path, message in (
        (tmp_path / "a.png", r"ends in \.exr"),
        (tmp_path / "none" / "a.exr", "cannot be written"),
        (tmp_path / "file" / "a.exr", "cannot be written"),
        (tmp_path / "folder.exr", "folder"),
        (tmp_path / f"{'n' * 252}.exr", "cannot be written"),
        (tmp_path / f"{'n' * 300}.exr", "cannot be written"),
    ):
        with pytest.raises(InputError, match=message):
            check_writable(path, ".exr")
        if message == "cannot be written":
            with pytest.raises(InputError, match=message):
                write_image(path, noise((2, 2, 3)))
    assert sorted(tmp_path.iterdir()) == before
    for suffix in (".exr", ".png", ".gif"):
        with pytest.raises(InputError, match=r"cannot be written|ends in"):
            write_image(tmp_path / "none" / f"a{suffix}", noise((2, 2, 3)))


@pytest.mark.parametrize("suffix", [".exr", ".png"])
@pytest.mark.parametrize("name", ["a\0b", "a\ud800"])
def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path, name: str, suffix: str) -> None:
    path = tmp_path / f"{name}{suffix}"
    for attempt in (lambda: check_writable(path, suffix), lambda: write_image(path, noise((2, 2, 3)))):
        with pytest.raises(InputError, match="expected a name that a file can have"):
            attempt()


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".pfm", ".png"])
def test_a_folder_whose_name_is_no_text_is_told_before(tmp_path: Path, suffix: str) -> None:
    folder = tmp_path / os.fsdecode(b"bad\xff")
    folder.mkdir()
    path = folder / f"a{suffix}"
    attempts = [lambda: check_writable(path, suffix), lambda: write_image(path, noise((2, 2, 3)))]
    if suffix == ".exr":
        for attempt in attempts:
            attempt()
        return
    messages = [
        rf"bad\udcff/a\{suffix}: expected a folder with a name",
        r"bad\udcff: expected a name in UTF-8",
    ]
    for attempt, message in zip(attempts, messages, strict=True):
        with pytest.raises(InputError, match=message):
            attempt()
    write_image(tmp_path / os.fsdecode(b"bad\xff" + suffix.encode()), noise((2, 2, 3)))
    assert not list(folder.iterdir())


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".pfm", ".png"])
@pytest.mark.parametrize("missing", [1, 1000])
def test_a_disk_that_fills_up_leaves_the_old_file(tmp_path: Path, suffix: str, missing: int) -> None:
    image = np.random.default_rng(0).random((80, 90, 3)).astype(np.float32)
    path = tmp_path / f"a{suffix}"
    write_image(path, image)
    room = path.stat().st_size - missing
    path.write_bytes(b"old")
    program = (
        "import resource, signal, sys, numpy as np; from tungsten_dip.buffers.image_file import write_image\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room}))\n"
        "write_image(sys.argv[1], np.random.default_rng(0).random((80, 90, 3)).astype(np.float32))"
    )
    done = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True)
    reason = done.stderr.splitlines()[-1]
    assert f"InputError: {path}: cannot be written (" in reason
    assert "on a disk with room" in reason
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"old"]


def test_a_loop_of_links_cannot_be_written(tmp_path: Path) -> None:
    path = tmp_path / "loop.exr"
    path.symlink_to(path)
    for attempt in (lambda: check_writable(path, ".exr"), lambda: write_image(path, noise((2, 2, 3)))):
        with pytest.raises(InputError, match="cannot be written"):
            attempt()


@pytest.mark.parametrize("suffix", [".exr", ".pfm", ".hdr", ".png"])
@pytest.mark.parametrize("shape", [(4, 5), (4, 5, 0), (4, 5, 2), (4, 5, 4), (0, 5, 3), (4, 0, 1)])
def test_what_is_no_picture_is_refused(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"expected a picture of shape \(height, width, 1 or 3\), got"):
        write_image(tmp_path / f"a{suffix}", np.zeros(shape, np.float32))
    assert not list(tmp_path.iterdir())
