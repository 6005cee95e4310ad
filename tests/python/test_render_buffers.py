"""Buffers that are made of arrays: what they refuse, and how they tell it."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from fractions import Fraction
from typing import get_args

import numpy as np
import pytest

import tungsten_dip as dip
from tungsten_dip.buffers.render_buffers import (
    TRAITS,
    Buffer,
    Quantity,
    RenderBuffers,
    mean_of,
    variance_of_mean,
)
from tungsten_dip.errors import InputError
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings

GREY = np.full((4, 5, 3), 0.5, np.float32)
NOISY = RenderBuffers(Buffer(GREY))
RESULT = FitResult(GREY, FitSettings(), seconds=0, iterations=0)


def test_what_the_quantities_are_is_told_of_each():
    buffers = [field.name for field in fields(RenderBuffers) if str(field.type).startswith("Buffer")]
    assert buffers == list(TRAITS) == list(get_args(Quantity))


def unaligned() -> np.ndarray:
    return np.frombuffer(b"\0" * (GREY.nbytes + 1), np.float32, offset=1).reshape(GREY.shape)


@pytest.mark.parametrize(
    ("half", "words"),
    [
        (GREY.astype(np.float64), "expected float32, got float64"),
        (GREY[:3], r"expected shape \(4, 5, 3\)"),
        (GREY[:, :, :1], r"expected shape \(height, width, 3\)"),
        (np.asfortranarray(GREY), "expected aligned rows"),
        (unaligned(), "expected aligned rows"),
    ],
)
def test_arrays_of_another_kind_are_refused(half, words):
    with pytest.raises(InputError, match=f"^color half_a: {words}"):
        RenderBuffers(Buffer(GREY, half, GREY))


def of_shape(*shape: int) -> np.ndarray:
    return np.ones(shape, np.float32)


@pytest.mark.parametrize(
    ("quantity", "shape", "remedy"),
    [
        ("color", (4, 5), "numpy.dstack([image] * 3) makes three channels of one"),
        ("color", (4, 5, 1), "numpy.dstack([image] * 3) makes three channels of one"),
        ("color", (4, 5, 4), "use image[..., :3].copy(), and image[..., 3:].copy() as alpha"),
        ("color", (3, 4, 5), "give one image, its channels on the last axis"),
        ("color", (1, 4, 5, 3), "give one image, its channels on the last axis"),
        ("color", (5,), "give one image, its channels on the last axis"),
        ("depth", (4, 5), "image[..., None] adds the axis of channels"),
        ("depth", (4, 5, 3), "give one image, its channels on the last axis"),
        ("depth", (5, 4, 1), "render all buffers at one size"),
        ("alpha", (4, 5), "image[..., None] adds the axis of channels"),
        ("spp", (4, 6, 1), "render all buffers at one size"),
    ],
)
def test_an_array_of_another_shape_is_told_how_to_fit(quantity, shape, remedy):
    array = of_shape(*shape)
    given = array if quantity in ("alpha", "spp") else Buffer(array)
    with pytest.raises(InputError, match=f"^{quantity}.*: expected shape .*; {re.escape(remedy)}$"):
        RenderBuffers(**{"color": Buffer(GREY), quantity: given})


def test_the_remedies_for_shapes_help():
    grey, rgba, depth = of_shape(4, 5), of_shape(4, 5, 4), of_shape(4, 5)
    color = Buffer(rgba[..., :3].copy(), np.dstack([grey] * 3), np.dstack([grey[..., None]] * 3))
    RenderBuffers(color, depth=Buffer(depth[..., None]), alpha=rgba[..., 3:].copy())


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Buffer(None), "mean: expected ndarray, got NoneType; use numpy.asarray"),
        (lambda: Buffer(GREY.tolist()), "mean: expected ndarray, got list; "),
        (lambda: Buffer(GREY, "A", GREY), "half_a: expected ndarray, got str; "),
        (lambda: RenderBuffers(GREY), r"color: expected Buffer, got ndarray; use Buffer\(array\)"),
        (lambda: RenderBuffers(None), "color: expected Buffer, got NoneType; "),
        (lambda: RenderBuffers(Buffer(GREY), albedo=GREY), "albedo: expected Buffer, got ndarray; "),
        (lambda: RenderBuffers(Buffer(GREY), alpha=[1]), "alpha: expected ndarray, got list; "),
        (lambda: dip.denoise("kitchen"), "buffers: expected RenderBuffers, got str; read_buffers reads"),
        (lambda: dip.denoise(RenderBuffers(Buffer(GREY)), "draft"), "settings: expected FitSettings"),
        (lambda: dip.denoise(RenderBuffers(Buffer(GREY)), warm_start="m.onnx"), "warm_start: expected Model"),
        (lambda: dip.infer("m.onnx", RenderBuffers(Buffer(GREY))), "model: expected Model, got str; load_"),
        (lambda: dip.save_model("m.onnx", None), "model: expected Model, got NoneType; a fit returns it"),
        (lambda: dip.compare(GREY.tolist(), GREY), "image: expected ndarray, got list; read_image reads"),
        (lambda: dip.compare(GREY, "ref.exr"), "reference: expected ndarray, got str; read_image reads"),
    ],
)
def test_what_is_of_another_type_is_refused(call, words):
    with pytest.raises(InputError, match=f"^{words}"):
        call()


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.ma.masked_array(GREY, mask=GREY > 0), r"expected an array without a mask, .*; use \.filled\(0\)"),
        (GREY.astype(complex), "expected real numbers, got complex128; "),
        (GREY.astype(object), "expected real numbers, got object; "),
        (GREY.tolist(), "expected ndarray, got list; "),
    ],
)
@pytest.mark.parametrize(
    ("what", "take"),
    [
        ("half_a", lambda image, _: Buffer(GREY, image, GREY)),
        ("alpha", lambda image, _: RenderBuffers(Buffer(GREY), alpha=image)),
        ("spp", lambda image, _: RenderBuffers(Buffer(GREY), spp=image)),
        ("image", lambda image, _: dip.compare(image, GREY)),
        ("reference", lambda image, _: dip.compare(GREY, image)),
        ("a.png", lambda image, folder: dip.write_image(folder / "a.png", image)),
        (
            "result color",
            lambda image, folder: dip.write_denoised(folder / "a.exr", replace(RESULT, color=image), NOISY),
        ),
        (
            "result error",
            lambda image, folder: dip.write_denoised(folder / "a.exr", replace(RESULT, error=image), NOISY),
        ),
    ],
)
def test_images_that_are_no_arrays_of_numbers_are_refused(what, take, image, words, tmp_path):
    with pytest.raises(InputError, match=f"{what}: {words}"):
        take(image, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("spp", [16, np.int64(16), np.float32(16), Fraction(16)])
def test_samples_per_pixel_may_be_any_number(spp, tmp_path):
    buffers = replace(NOISY, spp=spp)
    assert type(buffers.spp) is float
    dip.write_denoised(tmp_path / "a.exr", RESULT, buffers)
    assert dip.read_buffers(tmp_path / "a.exr").spp == 16


@pytest.mark.parametrize("spp", ["16", 0, -1.0, float("nan"), float("inf"), 2**31, 16j])
def test_samples_per_pixel_that_are_no_such_number_are_refused(spp):
    with pytest.raises(InputError, match=r"^spp: expected .*, got "):
        RenderBuffers(Buffer(GREY), spp=spp)


def test_what_is_asked_for_helps():
    assert RenderBuffers(Buffer(GREY, unaligned().copy(), np.asfortranarray(GREY).copy())).width == 5


@pytest.mark.parametrize("spp", [-1.0, float("nan"), float("inf"), 2.0**32])
def test_impossible_numbers_of_samples_in_a_pixel_are_refused(spp):
    counts = of_shape(4, 5, 1)
    counts[1, 2] = 0
    assert RenderBuffers(Buffer(GREY), spp=counts).spp is counts
    counts[1, 2] = spp
    with pytest.raises(InputError, match=r"^spp: expected numbers from 0 to"):
        RenderBuffers(Buffer(GREY), spp=counts)


def test_the_variance_of_the_mean_is_what_independent_halves_scatter_by():
    random = np.random.default_rng(1)
    half_a, half_b = random.normal(5, 2, (2, 300, 400, 3)).astype(np.float32)
    spread = mean_of((half_a, half_b)).var()
    assert variance_of_mean((half_a, half_b)).mean() == pytest.approx(spread, rel=0.02)
