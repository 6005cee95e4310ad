"""Reading buffers: every input that renderers leave behind, and what is wrong with some of them."""

from __future__ import annotations

import json
import logging
import string
import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio  # noqa: N813
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from tungsten_dip.buffers import image_file
from tungsten_dip.buffers.image_file import write_image
from tungsten_dip.buffers.read import input_files, read_buffers, read_image
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.errors import InputError

HEIGHT, WIDTH = 5, 7


def pixels(seed: int, dtype: type = np.float32, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width)).astype(dtype)


def save(path: Path, *names: str, dtype: type = np.float32, **header: object) -> dict[str, np.ndarray]:
    """Save channels of different noise and return them."""
    channels = {name: pixels(index, dtype) for index, name in enumerate(names)}
    save_channels(path, channels, **header)
    return channels


def save_channels(path: Path, channels: dict[str, np.ndarray], **header: object) -> None:
    copies = {name: channel.copy() for name, channel in channels.items()}
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, copies).write(str(path))


def save_parts(path: Path, **parts: dict[str, np.ndarray]) -> None:
    window = np.array([0, 0], "i"), np.array([WIDTH - 1, HEIGHT - 1], "i")  # display windows must agree
    header = {"type": OpenEXR.scanlineimage, "displayWindow": window}
    OpenEXR.File(
        [
            OpenEXR.Part(header.copy(), {n: c.copy() for n, c in channels.items()}, name)
            for name, channels in parts.items()
        ]
    ).write(str(path))


def rgb(layer: str) -> list[str]:
    return [f"{layer}.{component}" for component in "RGB"]


def xyz(layer: str) -> list[str]:
    return [f"{layer}.{component}" for component in "XYZ"]


def holds(buffer: Buffer | None, channels: dict[str, np.ndarray], *names: str) -> bool:
    assert buffer is not None
    return np.array_equal(buffer.mean, np.stack([channels[name] for name in names], axis=-1))


# Channels as the renderer names them, and what must be found: quantity -> channels. None: nothing.
RENDERERS = {
    "blender": (
        [
            *[f"ViewLayer.Combined.{c}" for c in "RGBA"],
            "ViewLayer.Depth.Z",
            *xyz("ViewLayer.Normal"),
            *rgb("ViewLayer.DiffCol"),
            *rgb("ViewLayer.DiffDir"),
            "ViewLayer.Mist.Z",
        ],
        {
            "color": rgb("ViewLayer.Combined"),
            "albedo": rgb("ViewLayer.DiffCol"),
            "normal": xyz("ViewLayer.Normal"),
            "depth": ["ViewLayer.Depth.Z"],
            "alpha": ["ViewLayer.Combined.A"],
        },
    ),
    "blender, denoised by itself": (
        [
            *rgb("Composite.Combined"),
            *rgb("ViewLayer.Combined"),
            *rgb("ViewLayer.Noisy Image"),
            *rgb("ViewLayer.Denoising Albedo"),
            *rgb("ViewLayer.DiffCol"),
            *xyz("ViewLayer.Denoising Normal"),
            *xyz("ViewLayer.Normal"),
            "ViewLayer.Denoising Depth.Z",
        ],
        {
            "color": rgb("ViewLayer.Noisy Image"),
            "albedo": rgb("ViewLayer.Denoising Albedo"),
            "normal": xyz("ViewLayer.Denoising Normal"),
            "depth": ["ViewLayer.Denoising Depth.Z"],
        },
    ),
    "blender, composited": (
        [*rgb("Composite.Combined"), *rgb("ViewLayer.Combined")],
        {"color": rgb("ViewLayer.Combined")},
    ),
    "blender, a view layer of the background without features": (
        [
            *rgb("BG.Combined"),
            *rgb("ViewLayer.Combined"),
            *rgb("ViewLayer.Denoising Albedo"),
            *xyz("ViewLayer.Denoising Normal"),
        ],
        {
            "color": rgb("ViewLayer.Combined"),
            "albedo": rgb("ViewLayer.Denoising Albedo"),
            "normal": xyz("ViewLayer.Denoising Normal"),
        },
    ),
    "blender, features of another view layer": (
        [*rgb("A.Combined"), *rgb("A.Mist"), *rgb("A.Env"), *rgb("A.Emit"), *rgb("B.DiffCol")],
        {"color": rgb("A.Combined")},
    ),
    "blender, two view layers": (
        [
            *rgb("Back.Normal"),
            *rgb("Front.DiffCol"),
            *rgb("Front.Noisy Image"),
            *rgb("Back.Combined"),
            *rgb("Back.Denoising Albedo"),
        ],
        {"color": rgb("Front.Noisy Image"), "albedo": rgb("Front.DiffCol")},
    ),
    "arnold": (
        [
            *"RGBA",
            *rgb("diffuse_albedo"),
            *rgb("denoise_albedo"),
            *xyz("N"),
            *xyz("P"),
            "Z",
            *rgb("variance"),
        ],
        {
            "color": [*"RGB"],
            "albedo": rgb("denoise_albedo"),
            "normal": xyz("N"),
            "depth": ["Z"],
            "alpha": ["A"],
        },
    ),
    "arnold, layer names kept": (
        [*rgb("RGBA"), "RGBA.A", *xyz("N"), *xyz("N_noice"), "Z.Z", "Z_noice.Z"],
        {"color": rgb("RGBA"), "normal": xyz("N_noice"), "depth": ["Z_noice.Z"], "alpha": ["RGBA.A"]},
    ),
    "pbrt": (
        [*"RGB", *rgb("Albedo"), *xyz("P"), "dzdx", "dzdy", *xyz("N"), *xyz("Ns"), "u", "v"],
        {"color": [*"RGB"], "albedo": rgb("Albedo"), "normal": xyz("Ns")},
    ),
    "mitsuba": (
        [*"RGB", *rgb("albedo"), "dd.y.T", *rgb("img"), "img.A", *xyz("nn"), *xyz("pos")],
        {"color": [*"RGB"], "albedo": rgb("albedo"), "normal": xyz("nn"), "depth": ["dd.y.T"]},
    ),
    "mitsuba, moments": (
        [*"RGBA", *rgb("aov.albedo"), *xyz("aov.nn"), *rgb("m2_aov.albedo"), *xyz("m2_aov.nn")],
        {"color": [*"RGB"], "albedo": rgb("aov.albedo"), "normal": xyz("aov.nn"), "alpha": ["A"]},
    ),
    "mitsuba, moments before what they are of": (
        [*"RGB", *rgb("m2_scene.albedo"), *rgb("scene.albedo")],
        {"color": [*"RGB"], "albedo": rgb("scene.albedo")},
    ),
    "components in lower case": (["Ci.r", "Ci.g", "Ci.b"], {"color": ["Ci.r", "Ci.g", "Ci.b"]}),
    "grey": (["Y"], {"color": ["Y", "Y", "Y"]}),
}


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_layers_of_renderers_are_recognised(tmp_path: Path, renderer: str, dtype: type) -> None:
    names, expected = RENDERERS[renderer]
    channels = save(tmp_path / "a.exr", *names, dtype=dtype)
    buffers = read_buffers(tmp_path / "a.exr")
    assert {name for name, _ in buffers.quantities()} == expected.keys() - {"alpha"}
    for quantity, taken in expected.items():
        if quantity != "alpha":
            assert holds(getattr(buffers, quantity), channels, *taken), quantity
            assert getattr(buffers, quantity).mean.dtype == np.float32
    alpha = expected.get("alpha")
    assert (buffers.alpha is None) == (alpha is None)
    assert alpha is None or np.array_equal(buffers.alpha[..., 0], channels[alpha[0]])
    assert buffers.color.variance is None


def test_variance_of_pbrt_is_that_of_one_sample(tmp_path: Path) -> None:
    names = [*"RGB", *rgb("Variance"), *rgb("RelativeVariance")]
    channels = save(tmp_path / "a.exr", *names, samplesPerPixel=16)
    buffers = read_buffers(tmp_path / "a.exr")
    assert buffers.spp == 16
    assert np.array_equal(buffers.color.variance[..., 1], channels["Variance.G"] / np.float32(16))


@pytest.mark.parametrize("count", [-1.0, 0.0, np.nan, np.inf, 1e30])
def test_an_impossible_number_of_samples_is_ignored(tmp_path: Path, count: float) -> None:
    save(tmp_path / "a.exr", *"RGB", samplesPerPixel=count)
    assert read_buffers(tmp_path / "a.exr").spp is None


def test_a_layer_of_impossible_numbers_of_samples_is_ignored(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    channels = {name: pixels(index) for index, name in enumerate([*"RGB", "spp"])}
    channels["spp"][1, 2] = np.nan
    save_channels(tmp_path / "a.exr", channels)
    assert read_buffers(tmp_path / "a.exr").spp is None
    assert "ignored: spp, because" in caplog.text


def test_of_several_views_the_one_that_is_denoised_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    names = ["rgb.left", "rgb.right", "albedo.left", "albedo.right"]
    images = {
        name: {channel: pixels(3 * i + c) for c, channel in enumerate("RGB")} for i, name in enumerate(names)
    }
    OpenEXR.File(
        [
            OpenEXR.Part(
                {"type": OpenEXR.scanlineimage, "view": name.partition(".")[2]},
                {channel: image.copy() for channel, image in channels.items()},
                name,
            )
            for name, channels in images.items()
        ]
    ).write(str(tmp_path / "parts.exr"))
    read_buffers(tmp_path / "parts.exr")
    assert "views left, right: only rgb.left.RGB is denoised" in caplog.text
    caplog.clear()
    right = read_buffers(tmp_path / "parts.exr", {"color": "rgb.right", "albedo": "albedo.right"})
    for buffer, name in ((right.color, "rgb.right"), (right.albedo, "albedo.right")):
        np.testing.assert_array_equal(buffer.mean, np.dstack(list(images[name].values())))
    assert "views" not in caplog.text

    save(tmp_path / "layers.exr", *"RGB", *rgb("right"), multiView=["left", "right"])
    read_buffers(tmp_path / "layers.exr")
    assert "views left, right: only RGB is denoised" in caplog.text
    caplog.clear()
    save(tmp_path / "one.exr", *"RGB", view="left")
    read_buffers(tmp_path / "one.exr")
    assert not caplog.text


def test_of_several_view_layers_the_one_that_is_denoised_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    layers = [f"{view}.{layer}" for view in ("Back", "Fore") for layer in ("Combined", "DiffCol")]
    channels = save(tmp_path / "a.exr", *(name for layer in layers for name in rgb(layer)))
    read_buffers(tmp_path / "a.exr")
    assert "view layers Back, Fore: only Back.Combined.RGB is denoised; choose others with" in caplog.text
    caplog.clear()
    fore = read_buffers(tmp_path / "a.exr", {"color": "Fore.Combined"})
    assert holds(fore.color, channels, *rgb("Fore.Combined"))
    assert holds(fore.albedo, channels, *rgb("Fore.DiffCol"))
    save(tmp_path / "one.exr", *rgb("Back.Combined"), *rgb("Back.Noisy Image"), *rgb("Composite.Combined"))
    read_buffers(tmp_path / "one.exr")
    save(tmp_path / "top.exr", *"RGB", *rgb("key.beauty"), *rgb("fill.beauty"))
    read_buffers(tmp_path / "top.exr")
    assert not caplog.text


def test_variance_of_unknown_scale_is_taken_only_when_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    channels = save(tmp_path / "a.exr", *"RGB", *rgb("variance"))
    with caplog.at_level(logging.INFO):
        assert read_buffers(tmp_path / "a.exr").color.variance is None
    assert "--map colorVariance=" in caplog.text
    buffers = read_buffers(tmp_path / "a.exr", {"colorVariance": "variance"})
    assert np.array_equal(buffers.color.variance[..., 2], channels["variance.B"])


def test_halves_and_variances_stand_beside_their_layer(tmp_path: Path) -> None:
    ours = [
        *rgb("color"),
        *rgb("colorA"),
        *rgb("colorB"),
        *rgb("colorVariance"),
        "depth.Y",
        "depthVariance.Y",
    ]
    channels = save(tmp_path / "a.exr", *ours)
    buffers = read_buffers(tmp_path / "a.exr")
    assert [name for name, _ in buffers.color.planes()] == ["mean", "half_a", "half_b", "variance"]
    assert np.array_equal(buffers.color.half_b[..., 0], channels["colorB.R"])
    assert [name for name, _ in buffers.depth.planes()] == ["mean", "variance"]
    channels = save(tmp_path / "b.exr", *rgb("L.Combined"), *rgb("L.Combined_A"), *rgb("L.Combined_B"))
    assert np.array_equal(read_buffers(tmp_path / "b.exr").color.half_a[..., 0], channels["L.Combined_A.R"])


def test_what_was_taken_for_what_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save(tmp_path / "a.exr", *"RGBA", *rgb("albedo"), *xyz("P"), "id")
    with caplog.at_level(logging.INFO):
        read_buffers(tmp_path / "a.exr")
    lines = [record.getMessage() for record in caplog.records]
    assert "color: mean RGB" in lines
    assert "albedo: mean albedo.RGB" in lines
    assert "alpha: A" in lines
    assert "ignored: id, P" in lines


def test_luminance_and_chroma_are_not_taken_for_a_grey_picture(tmp_path: Path) -> None:
    save(tmp_path / "a.exr", "Y", "RY", "BY")
    save(tmp_path / "b.exr", "Y")
    for read in (lambda path: read_buffers(path).color.mean, read_image):
        with pytest.raises(InputError, match=r"a\.exr: the colour is luminance and chroma"):
            read(tmp_path / "a.exr")
        assert np.ptp(read(tmp_path / "b.exr"), axis=2).max() == 0


@pytest.mark.parametrize("name", ["color", "color.Y", "noisy", "noisy.foo"])
def test_three_channels_are_the_colour_rather_than_one(tmp_path: Path, name: str) -> None:
    channels = save(tmp_path / "a.exr", *"RGB", name)
    assert holds(read_buffers(tmp_path / "a.exr").color, channels, *"RGB")


def test_map_settles_the_rest(tmp_path: Path) -> None:
    channels = save(
        tmp_path / "a.exr", *rgb("main"), *rgb("odd"), "nx", "ny", "nz", "dist", *rgb("albedo"), "m"
    )
    mapping = {
        "color": "main",
        "colorA": "odd",
        "normal": "nx,ny,nz",
        "depth": "dist",
        "albedo": "none",
        "alpha": "m",
    }
    buffers = read_buffers(tmp_path / "a.exr", mapping)
    assert holds(buffers.color, channels, *rgb("main"))
    assert holds(buffers.normal, channels, "nx", "ny", "nz")
    assert holds(buffers.depth, channels, "dist")
    assert np.array_equal(buffers.color.half_a[..., 0], channels["odd.R"])
    assert np.array_equal(buffers.alpha[..., 0], channels["m"])
    assert buffers.albedo is None


def test_features_are_those_of_the_view_layer_that_the_map_names(tmp_path: Path) -> None:
    channels = save(
        tmp_path / "a.exr",
        *[
            name
            for view_layer in ("Back", "Front")
            for layer in ("Combined", "DiffDir", "DiffCol")
            for name in rgb(f"{view_layer}.{layer}")
        ],
        *xyz("Back.Normal"),
    )
    for layer in ("Front.Combined", "front.combined", "Front.DiffDir", ",".join(rgb("Front.Combined"))):
        buffers = read_buffers(tmp_path / "a.exr", {"color": layer})
        assert holds(buffers.albedo, channels, *rgb("Front.DiffCol"))
        assert buffers.normal is None


def test_the_map_chooses_between_two_spellings(tmp_path: Path) -> None:
    channels = save(tmp_path / "a.exr", *"RGB", *"rgb", "A")
    for spelling in ("RGB", "rgb"):
        buffers = read_buffers(tmp_path / "a.exr", {"color": ",".join(spelling)})
        assert holds(buffers.color, channels, *spelling)
        assert np.array_equal(buffers.alpha[..., 0], channels["A"])


def test_a_colour_whose_prefix_is_no_view_layer_has_the_features_of_any(tmp_path: Path) -> None:
    channels = save(tmp_path / "a.exr", *rgb("beauty.rgb"), *rgb("aov.albedo"), *xyz("aov.normal"))
    buffers = read_buffers(tmp_path / "a.exr", {"color": "beauty.rgb"})
    assert holds(buffers.color, channels, *rgb("beauty.rgb"))
    assert holds(buffers.albedo, channels, *rgb("aov.albedo"))
    assert holds(buffers.normal, channels, *xyz("aov.normal"))
    albedo = {name: pixels(index) for index, name in enumerate("RGB")}
    save_parts(tmp_path / "b.exr", **{"main.rgb": {n: pixels(9) for n in "RGB"}, "aov.albedo": albedo})
    assert holds(read_buffers(tmp_path / "b.exr").albedo, albedo, *"RGB")


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({"colour": "RGBA"}, "expected one of color, colorA"),
        ({"color": "beauty"}, "no such layer or channel; there are"),
        ({"color": "two"}, "name the channels"),
        ({"color": "none"}, "no colour"),
        ({"depth": "odd"}, "expected 1 channels"),
        ({"normal": "Z"}, "expected 3 channels"),
        ({"alpha": "odd"}, "alpha: expected 1 channels, found odd.R, odd.G, odd.B; choose with --map"),
        ({"albedoA": "odd"}, "no mean"),
    ],
)
def test_a_wrong_map_is_refused(tmp_path: Path, mapping: dict[str, str], message: str) -> None:
    save(tmp_path / "a.exr", *"RGB", *rgb("odd"), "two.u", "two.v", "Z")
    with pytest.raises(InputError, match=message):
        read_buffers(tmp_path / "a.exr", mapping)


def test_alpha_may_be_spelled_out_as_the_colours_are(tmp_path: Path) -> None:
    channels = save(tmp_path / "a.exr", *(f"beauty.{name}" for name in ("red", "green", "blue", "alpha")))
    buffers = read_buffers(tmp_path / "a.exr")
    assert holds(buffers.color, channels, "beauty.red", "beauty.green", "beauty.blue")
    assert buffers.alpha is not None
    assert np.array_equal(buffers.alpha[..., 0], channels["beauty.alpha"])


def test_parts_are_layers(tmp_path: Path) -> None:
    color = {name: pixels(i) for i, name in enumerate("RGBA")}
    normal = {name: pixels(i + 9, np.float16) for i, name in enumerate("XYZ")}
    depth = {"Z": pixels(20)}
    for first in ("rgba", "beauty", "whatever"):
        save_parts(
            tmp_path / "a.exr", **{first: color, "normal": normal, "depth": depth, "id": {"id": pixels(3)}}
        )
        buffers = read_buffers(tmp_path / "a.exr")
        assert holds(buffers.color, color, *"RGB")
        assert holds(buffers.normal, normal, *"XYZ")
        assert holds(buffers.depth, depth, "Z")
        assert np.array_equal(buffers.alpha[..., 0], color["A"])
    save_parts(tmp_path / "a.exr", albedo={n: pixels(i) for i, n in enumerate("RGB")}, main=color)
    with pytest.raises(InputError, match=r"no colour.*albedo, main.*--map color=LAYER"):
        read_buffers(tmp_path / "a.exr")
    assert holds(read_buffers(tmp_path / "a.exr", {"color": "main"}).color, color, *"RGB")


def test_a_layer_named_like_its_part_hides_no_channel(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    names = [*"RGB", *rgb("beauty")]
    channels = {name: pixels(index) for index, name in enumerate(names)}
    save_parts(tmp_path / "a.exr", beauty=channels, normal={n: pixels(9) for n in "XYZ"})
    with caplog.at_level(logging.INFO):
        assert holds(read_buffers(tmp_path / "a.exr").color, channels, *rgb("beauty"))
    assert "ignored: beauty" in caplog.messages
    mapping = {"color": "beauty"}
    assert holds(read_buffers(tmp_path / "a.exr", mapping).color, channels, *"RGB")


def test_tiles_and_mipmaps(tmp_path: Path) -> None:
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 4
    names = [*"RGB", *rgb("albedo")]
    channels = save(tmp_path / "a.exr", *names, type=OpenEXR.tiledimage, tiles=tiles)
    buffers = read_buffers(tmp_path / "a.exr")
    assert holds(buffers.color, channels, *"RGB")
    assert holds(buffers.albedo, channels, *rgb("albedo"))


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (33, 1), (17, 13)])
@pytest.mark.parametrize("suffix", [".exr", ".pfm", ".hdr"])
def test_sizes_and_formats_of_single_images(tmp_path: Path, size: tuple[int, int], suffix: str) -> None:
    image = np.random.default_rng(0).random((*size, 3), dtype=np.float32)
    path = tmp_path / f"a{suffix}"
    if suffix == ".pfm":  # as Tungsten writes it: rows bottom up
        path.write_bytes(b"PF\n%d %d\n-1\n" % (size[1], size[0]) + image[::-1].tobytes())
    else:
        output = oiio.ImageOutput.create(str(path))
        assert output.open(str(path), oiio.ImageSpec(size[1], size[0], 3, "float"))
        assert output.write_image(image)
        output.close()
    tolerance = 1 / 128 if suffix == ".hdr" else 0  # RGBE has 8 bits of mantissa
    assert np.abs(read_buffers(path).color.mean - image).max() <= tolerance
    assert np.array_equal(read_image(path), read_buffers(path).color.mean)


def test_nan_and_infinity_are_left_for_the_mender(tmp_path: Path) -> None:
    image = np.full((2, 3), np.nan, np.float16)
    image[0, 0], image[0, 1] = np.inf, -np.inf
    save_channels(tmp_path / "a.exr", dict.fromkeys([*"RGB", *rgb("depth")], image))
    buffers = read_buffers(tmp_path / "a.exr")
    assert np.array_equal(buffers.color.mean[..., 1], image, equal_nan=True)
    assert np.array_equal(buffers.depth.mean[..., 0], image, equal_nan=True)  # three equal channels


# Folders and scenes


def save_folder(
    folder: Path, suffix: str = ".exr", keys: tuple[str, ...] = ("color", "normal", "depth")
) -> None:
    for key in keys:
        names = "Y" if key.startswith(("depth", "visibility")) else "RGB"
        if suffix == ".exr":
            save(folder / f"{key}.exr", *names, dtype=np.float16)
        else:
            data = np.random.default_rng(len(key)).random((HEIGHT, WIDTH, len(names)), dtype=np.float32)
            ident = b"PF" if len(names) == 3 else b"Pf"
            (folder / f"{key}.pfm").write_bytes(ident + b"\n%d %d\n-1\n" % (WIDTH, HEIGHT) + data.tobytes())


@pytest.mark.parametrize("suffix", [".exr", ".pfm"])
def test_a_folder_of_tungsten(tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture) -> None:
    keys = tuple(
        quantity + plane
        for quantity in ("color", "albedo", "normal", "depth", "visibility")
        for plane in ("", "A", "B", "Variance")
    )
    save_folder(tmp_path, suffix, (*keys, "nfor"))
    (tmp_path / "notes.txt").write_text("not an image")
    with caplog.at_level(logging.INFO):
        buffers = read_buffers(tmp_path)
    assert [name for name, _ in buffers.quantities()] == ["color", "albedo", "normal", "depth", "visibility"]
    for _, buffer in buffers.quantities():
        assert len(list(buffer.planes())) == 4
    assert f"ignored: nfor{suffix}" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.INFO):
        assert len(input_files(tmp_path)) == len(keys)
    assert not caplog.records  # what is ignored is told by who reads


def test_a_folder_prefers_exr_and_follows_the_map(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save_folder(tmp_path)
    save_folder(tmp_path, ".pfm", ("color",))
    channels = save(tmp_path / "beauty.exr", *"RGB", dtype=np.float16)
    with caplog.at_level(logging.INFO):
        assert holds(
            read_buffers(tmp_path).color, save(tmp_path / "color.exr", *"RGB", dtype=np.float16), *"RGB"
        )
    assert "ignored: beauty.exr, color.pfm" in caplog.text
    with pytest.raises(InputError, match="no mean that this belongs to"):
        read_buffers(tmp_path, {"albedo": "none", "albedoA": "albedoA"})
    mapped = read_buffers(tmp_path, {"color": "beauty", "normal": "none", "albedo": "normal.exr"})
    assert holds(mapped.color, channels, *"RGB")
    assert mapped.normal is None
    assert mapped.albedo is not None
    with pytest.raises(InputError, match=r"there are beauty\.exr"):
        read_buffers(tmp_path, {"color": "missing.exr"})


@pytest.mark.parametrize(
    ("noisy", "denoised"), [("ViewLayer.Noisy Image", "ViewLayer.Combined"), ("noisy", "RGBA")]
)
def test_the_picture_is_what_a_renderer_denoised_itself(tmp_path: Path, noisy: str, denoised: str) -> None:
    path = tmp_path / "a.exr"
    channels = save(path, *rgb(noisy), *rgb(denoised), *rgb("ViewLayer.DiffCol"))
    np.testing.assert_array_equal(read_image(path), np.stack([channels[n] for n in rgb(denoised)], axis=-1))
    assert holds(read_buffers(path).color, channels, *rgb(noisy))
    # A single channel of that name is no picture.
    channels = save(path, *rgb(noisy), f"{denoised}.Z")
    np.testing.assert_array_equal(read_image(path), np.stack([channels[n] for n in rgb(noisy)], axis=-1))


@pytest.mark.parametrize("name", ["noisy", "Noisy Image", "color", "albedo"])
def test_the_other_parts_of_a_folders_files_are_not_taken_for_its_quantities(
    tmp_path: Path, name: str
) -> None:
    color, other = ({c: pixels(seed + i) for i, c in enumerate("RGB")} for seed in (0, 3))
    albedo = save(tmp_path / "albedo.exr", *"RGB", *rgb("Denoising Albedo"))
    save_parts(tmp_path / "color.exr", **{"rgba": color, name: other})
    buffers = read_buffers(tmp_path)
    assert holds(buffers.color, color, *"RGB")
    assert holds(buffers.albedo, albedo, *"RGB")


def test_the_colour_of_a_folder_may_be_a_layer_of_its_file(tmp_path: Path) -> None:
    channels = save(tmp_path / "color.exr", "id", *rgb("ViewLayer.Combined"), *rgb("ViewLayer.DiffCol"))
    buffers = read_buffers(tmp_path)
    assert holds(buffers.color, channels, *rgb("ViewLayer.Combined"))
    assert holds(buffers.albedo, channels, *rgb("ViewLayer.DiffCol"))


def test_the_map_excludes_the_parts_of_a_folders_files(tmp_path: Path) -> None:
    normal = {name: pixels(index) for index, name in enumerate("XYZ")}
    save(tmp_path / "color.exr", *"RGB")
    save_parts(
        tmp_path / "normal.exr",
        N=normal,
        albedo={name: pixels(index) for index, name in enumerate("RGB")},
        depth={"Z": pixels(9)},
    )
    buffers = read_buffers(tmp_path, {"albedo": "none", "depth": "none"})
    assert [name for name, _ in buffers.quantities()] == ["color", "normal"]
    assert holds(buffers.normal, normal, *"XYZ")


def test_a_scene_names_its_buffers(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "out").mkdir()
    for name in ("c", "cA", "cB", "cVariance", "n", "nVariance"):
        save(tmp_path / "out" / f"{name}.exr", *"RGB")
    save(tmp_path / "out" / "d.exr", "Y")
    scene = {
        "renderer": {
            "output_directory": "out",
            "output_buffers": [
                {"type": "depth", "hdr_output_file": "d.exr"},
                {"type": "normal", "hdr_output_file": "n.exr", "sample_variance": True},
                {
                    "type": "color",
                    "hdr_output_file": "c.exr",
                    "two_buffer_variance": True,
                    "sample_variance": True,
                },
                {"type": "albedo", "ldr_output_file": "albedo.png"},
            ],
        }
    }
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(scene))
    buffers = read_buffers(path)
    assert [name for name, _ in buffers.color.planes()] == ["mean", "half_a", "half_b", "variance"]
    assert [name for name, _ in buffers.normal.planes()] == ["mean", "variance"]
    assert buffers.depth is not None
    assert buffers.albedo is None
    (tmp_path / "out" / "cB.exr").unlink()
    with pytest.raises(InputError, match=r"cB.exr, which does not exist; render the scene first"):
        read_buffers(path)
    for name in ("cA", "cVariance"):
        (tmp_path / "out" / f"{name}.exr").unlink()
    with caplog.at_level(logging.INFO):
        assert [name for name, _ in read_buffers(path).color.planes()] == ["mean"]
    assert "color: no cA.exr, cB.exr, cVariance.exr" in caplog.text


def test_features_of_a_later_render_are_not_mixed_with_the_picture_of_an_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / "scene.json"
    renderer = {
        "hdr_output_file": "c.exr",
        "overwrite_output_files": False,
        "output_buffers": [{"type": "normal", "hdr_output_file": "n.exr"}],
    }
    path.write_text(json.dumps({"renderer": renderer}))
    for name in ("c", "n"):
        save(tmp_path / f"{name}.exr", *"RGB")
    read_buffers(path)
    save(tmp_path / "c001.exr", *"RGB")
    refused(path, "expected one picture beside its buffers, found c001.exr, too; .* alone, as c.exr")
    for other in ({"overwrite_output_files": True}, {"output_buffers": []}):
        path.write_text(json.dumps({"renderer": {**renderer, **other}}))
        read_buffers(path)


def test_a_scene_may_hold_comments_and_trailing_commas(tmp_path: Path) -> None:
    write_image(tmp_path / "c.exr", np.full((2, 3, 3), 0.5, np.float32))
    buffers = '[{"type": "color", "hdr_output_file": "c.exr"},]'
    text = f'\ufeff{{"renderer": {{ // what is saved\n "output_buffers": {buffers} }}}}'
    (tmp_path / "scene.json").write_text(text, encoding="utf-8")
    assert read_buffers(tmp_path / "scene.json").color.mean.shape == (2, 3, 3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{\n  broken", ":2:3: expected JSON"),
        ("[]", "expected a JSON object"),
        ('{"renderer": {"output_buffers": [{"hdr_output_file": "c.exr"}]}}', "renderer.output_buffers"),
        ('{"renderer": {"output_buffers": [{"type": [], "hdr_output_file": 3}]}}', "renderer.output_buffers"),
        ('{"renderer": {"output_buffers": 7}}', "renderer.output_buffers"),
        ('{"renderer": {}}', "saves no colour"),
        ("{}", "saves no colour"),
        ('{"renderer": {"hdr_output_file": "render.exr"}}', "render the scene first"),
        ("[" * 100_000, "nested too deeply"),
    ],
)
def test_a_broken_scene_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "scene.json").write_text(text)
    refused(tmp_path / "scene.json", message)


# What cannot be used


def refused(path: Path, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_buffers(path)
    line = str(caught.value)
    assert "\n" not in line
    assert path.name in line
    assert ";" in line, "the message ends in what to do"


def test_what_is_no_image_is_refused(tmp_path: Path) -> None:
    refused(tmp_path / "none.exr", "no such file")
    refused(tmp_path / "none.json", "expected a Tungsten scene file, found none")
    refused(tmp_path, "found no image.*--map color=FILE")
    for suffix in (".exr", ".pfm", ".hdr"):
        (tmp_path / f"text{suffix}").write_text("hello world " * 100)
        refused(tmp_path / f"text{suffix}", "no readable image")
        (tmp_path / f"empty{suffix}").touch()
        refused(tmp_path / f"empty{suffix}", "no readable image")
    (tmp_path / "a.png").touch()
    refused(tmp_path / "a.png", "linear radiance")


@pytest.mark.parametrize("read", [read_buffers, read_image])
@pytest.mark.parametrize("suffix", ["", ".exr", ".json"])
def test_names_too_long_to_exist_are_refused(read: Any, suffix: str) -> None:
    with pytest.raises(InputError, match=r"cannot be read \(File name too long\); check the path"):
        read("x" * 5000 + suffix)


def test_a_scene_that_saves_two_buffers_in_one_file_is_refused(tmp_path: Path) -> None:
    save(tmp_path / "c.exr", *"RGB")
    buffers = [{"type": quantity, "hdr_output_file": "c.exr"} for quantity in ("color", "albedo")]
    (tmp_path / "scene.json").write_text(json.dumps({"renderer": {"output_buffers": buffers}}))
    refused(tmp_path / "scene.json", r"expected one file for every buffer, got c\.exr twice; rename one")


def test_a_scene_may_name_what_cannot_exist(tmp_path: Path) -> None:
    renderer = {"hdr_output_file": "x" * 5000 + ".exr"}
    (tmp_path / "scene.json").write_text(json.dumps({"renderer": renderer}))
    refused(tmp_path / "scene.json", "does not exist; render the scene first")


@pytest.mark.parametrize("mapping", [np.zeros(3), "color=A", {"color": np.zeros(2)}])
def test_a_mapping_that_is_no_dictionary_of_texts_is_refused(tmp_path: Path, mapping: Any) -> None:
    save(tmp_path / "a.exr", *"RGB")
    with pytest.raises(InputError, match=r"\Amapping: expected a dictionary of texts .* got \w+( in it)?\Z"):
        read_buffers(tmp_path / "a.exr", mapping)


def test_every_truncation_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    save(tmp_path / "whole.exr", *"RGB", *rgb("albedo"))
    whole = (tmp_path / "whole.exr").read_bytes()
    for length in range(0, len(whole), 7):
        (tmp_path / "cut.exr").write_bytes(whole[:length])
        refused(tmp_path / "cut.exr", "no readable image|truncated|damaged")
    assert capfd.readouterr() == ("", ""), "the libraries must not print"


def test_a_file_of_several_parts_is_whole_to_its_last_byte_alone(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    save_parts(tmp_path / "whole.exr", color={n: pixels(0) for n in "RGB"}, id={"Y": pixels(1, np.float16)})
    assert image_file.is_whole(tmp_path / "whole.exr")
    whole = (tmp_path / "whole.exr").read_bytes()
    for length in [*range(0, len(whole), 7), len(whole) - 1]:
        (tmp_path / "cut.exr").write_bytes(whole[:length])
        assert not image_file.is_whole(tmp_path / "cut.exr")
    assert capfd.readouterr() == ("", ""), "the libraries must not print"


def test_damaged_bytes_read_or_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    save(tmp_path / "whole.exr", *"RGB", *rgb("albedo"), owner="somebody")
    whole = (tmp_path / "whole.exr").read_bytes()
    rng = np.random.default_rng(0)
    refusals = 0
    for _ in range(300):
        data = bytearray(whole)
        for at in rng.integers(0, 600, size=rng.integers(1, 4)):
            data[at] = rng.integers(0, 256)
        (tmp_path / "damaged.exr").write_bytes(data)
        try:
            read_buffers(tmp_path / "damaged.exr")
        except InputError:
            refusals += 1
    assert refusals > 0
    assert capfd.readouterr() == ("", ""), "the libraries must not print"


@pytest.mark.parametrize("several_parts", [False, True])
@pytest.mark.parametrize(
    ("value", "stored", "damaged", "reason"),
    [
        ("cafe", b"cafe", b"caf\xe9", r"expected text in UTF-8, got 'caf\xe9'"),
        (["a", "cafe"], b"cafe", b"caf\xe9", r"expected text in UTF-8, got 'caf\xe9'"),
        (Fraction(24, 7), b"\x18\0\0\0\7\0\0\0", b"\x18" + bytes(7), "got one whose denominator is 0"),
        (Fraction(24, 7), b"\x18\0\0\0\7\0\0\0", bytes(8), "got one whose denominator is 0"),
    ],
)
def test_attributes_that_python_cannot_hold_are_left_out_and_told(
    tmp_path: Path,
    value: object,
    stored: bytes,
    damaged: bytes,
    reason: str,
    several_parts: bool,
    caplog: pytest.LogCaptureFixture,
) -> None:
    header = {"type": OpenEXR.scanlineimage, "bad": value, "good": ["x" * 200, "y"]}
    parts = [OpenEXR.Part(dict(header), {n: pixels(i) for i, n in enumerate("RGB")}, "rgba")]
    if several_parts:
        parts.append(OpenEXR.Part(dict(header), {"Z": pixels(3)}, "depth"))
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    whole = read_buffers(tmp_path / "a.exr")
    (tmp_path / "a.exr").write_bytes((tmp_path / "a.exr").read_bytes().replace(stored, damaged))
    caplog.clear()
    buffers = read_buffers(tmp_path / "a.exr")
    np.testing.assert_array_equal(buffers.color.mean, whole.color.mean)
    assert (buffers.depth is not None) == several_parts
    assert whole.attributes.keys() - buffers.attributes.keys() == {"bad"}
    assert buffers.attributes["good"] == header["good"]
    lines = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(lines) == len(parts)
    assert lines[0].startswith(f"{tmp_path / 'a.exr'}: attribute bad is left out: ")
    assert lines[0].endswith(reason)
    assert image_file.read_attributes(tmp_path / "a.exr").keys() >= {"dataWindow", "good"}


def test_names_that_would_be_one_in_utf8_are_refused(tmp_path: Path) -> None:
    save(tmp_path / "a.exr", *"RGB", r"caf\xe9.Z", "cafe.Z")
    content = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(content.replace(b"cafe.Z", b"caf\xe9.Z"))
    refused(tmp_path / "a.exr", "expected channels of different names")


def test_a_header_that_claims_too_much_is_refused(tmp_path: Path) -> None:
    save(tmp_path / "a.exr", *"RGB")
    data = bytearray((tmp_path / "a.exr").read_bytes())
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    for corner in (10**9 - 1, 10**5, 20_000, 2**31 - 1, -9):
        data[at : at + 16] = struct.pack("<4i", 0, 0, corner, corner)
        (tmp_path / "a.exr").write_bytes(data)
        refused(tmp_path / "a.exr", "no readable image|pixels")
    (tmp_path / "a.pfm").write_bytes(b"PF\n60000 60000\n-1\n" + bytes(100))
    refused(tmp_path / "a.pfm", "no readable image|pixels")
    (tmp_path / "a.hdr").write_bytes(
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 60000 +X 60000\n" + bytes(100)
    )
    refused(tmp_path / "a.hdr", "no readable image|pixels")


def test_deep_pixels_are_refused(tmp_path: Path) -> None:
    spec = oiio.ImageSpec(2, 2, 1, "float")
    spec.deep, spec.channelnames = True, ("Z",)
    deep = oiio.DeepData()
    deep.init(spec)
    output = oiio.ImageOutput.create(str(tmp_path / "deep.exr"))
    assert output.open(str(tmp_path / "deep.exr"), spec)
    assert output.write_deep_image(deep)
    output.close()
    refused(tmp_path / "deep.exr", "flatten")


def test_sizes_must_agree(tmp_path: Path) -> None:
    save_folder(tmp_path)
    save_channels(tmp_path / "normal.exr", {name: pixels(0, height=4) for name in "RGB"})
    with pytest.raises(InputError, match=r"normal.exr: expected 7 x 5 .* got 7 x 4 .*one size"):
        read_buffers(tmp_path)
    window = np.array([2, 0], "i"), np.array([8, 4], "i")
    save(tmp_path / "normal.exr", *"RGB", dataWindow=window)
    with pytest.raises(InputError, match=r"got 7 x 5 pixels from \(2, 0\); bring all to one data window"):
        read_buffers(tmp_path)
    save_parts(tmp_path / "p.exr", rgba={n: pixels(0) for n in "RGB"}, depth={"Z": pixels(0, width=9)})
    refused(tmp_path / "p.exr", "expected 7 x 5 .*, got 9 x 5 .*; render all at .*, or use --map depth=none")


def test_where_the_map_chooses_no_layers_the_advice_is_another(tmp_path: Path) -> None:
    save(tmp_path / "depth.exr", *"RGB")
    save(tmp_path / "color.exr", *"RGB")
    with pytest.raises(InputError, match=r"depth: expected 1 channels, .*; save its file with what is exp"):
        read_buffers(tmp_path)
    save(tmp_path / "a.exr", *"RGB", *rgb("depth"))
    refused(tmp_path / "a.exr", r"depth: expected 1 channels, .*; choose with --map depth=CHANNEL\Z")
    assert read_buffers(tmp_path / "a.exr", {"depth": "depth.R"}).depth is not None
    save(tmp_path / "color.exr", "id", "mask")
    with pytest.raises(InputError, match=r"no colour: expected R, G, B or .*; save its file with what is ex"):
        read_buffers(tmp_path)
    save(tmp_path / "a.exr", *"RG")
    refused(tmp_path / "a.exr", r"no colour: .*; use --map color=LAYER\Z")


def test_without_colour(tmp_path: Path) -> None:
    save(tmp_path / "a.exr", *rgb("albedo"), "Z")
    refused(tmp_path / "a.exr", "no colour.*found Z, albedo; use --map color=LAYER")
    save(tmp_path / "b.exr", "R", "G")
    refused(tmp_path / "b.exr", "no colour.*found R, G; use --map")
    with pytest.raises(InputError, match=r"a\.exr: expected R, G, B or Y, .*found Z, albedo\); name another"):
        read_image(tmp_path / "a.exr")


def test_the_picture_of_a_file_without_one_at_the_top_level_is_its_colour(tmp_path: Path) -> None:
    channels = save(tmp_path / "a.exr", *rgb("ViewLayer.Combined"), "ViewLayer.Depth.Z")
    picture = read_image(tmp_path / "a.exr")
    for index, name in enumerate(rgb("ViewLayer.Combined")):
        assert np.array_equal(picture[:, :, index], channels[name])


@pytest.mark.parametrize("window", [(WIDTH, HEIGHT), (WIDTH + 2, HEIGHT)])
def test_the_picture_is_found_in_any_part_whatever_fits_it(tmp_path: Path, window: tuple[int, int]) -> None:
    width, height = window
    color = {n: pixels(seed, height=height, width=width) for seed, n in enumerate("RGB")}
    noisy = {n: pixels(seed + 3) for seed, n in enumerate("RGB")}
    for others in ({}, {"Noisy Image": noisy}):
        save_parts(tmp_path / "a.exr", depth={"Z": pixels(9)}, **others, Combined=color)
        picture = read_image(tmp_path / "a.exr")
        np.testing.assert_array_equal(picture, np.stack(list(color.values()), axis=-1))
        assert picture.flags.c_contiguous


def test_depth_of_three_different_channels(tmp_path: Path) -> None:
    channels = save(tmp_path / "a.exr", *"RGB", *rgb("depth"))
    refused(tmp_path / "a.exr", "depth: expected 1 channels")
    assert holds(read_buffers(tmp_path / "a.exr", {"depth": "depth.R"}).depth, channels, "depth.R")


NAME = st.text(string.ascii_letters + string.digits + "._- äß", min_size=1, max_size=12)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(names=st.lists(NAME, min_size=1, max_size=12, unique=True), known=st.booleans())
def test_any_mix_of_channel_names_reads_or_is_refused(tmp_path: Path, names: list[str], known: bool) -> None:
    names = list(dict.fromkeys([*names, *([*"RGB"] if known else [])]))
    channels = {name: pixels(index, np.float16, 1, 2) for index, name in enumerate(names)}
    save_channels(tmp_path / "a.exr", channels)
    try:
        buffers = read_buffers(tmp_path / "a.exr")
    except InputError:
        assume(False)
    assert isinstance(buffers, RenderBuffers)
    assert buffers.source.parts[0].channels.keys() == channels.keys()
    for name, channel in buffers.source.parts[0].channels.items():
        assert channel.tobytes() == channels[name].tobytes()
        assert channel.dtype == np.float16


@pytest.mark.parametrize("order", ["+Y 2 +X 8", "-Y 2 -X 8", "+X 8 -Y 2"])
def test_radiance_pictures_in_another_order_of_pixels_are_refused(tmp_path: Path, order: str) -> None:
    for known in ("-Y 2 +X 8", order):
        header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n{known}\n"
        (tmp_path / f"{known}.hdr").write_bytes(header.encode() + bytes(range(64)))
    assert read_image(tmp_path / "-Y 2 +X 8.hdr").shape == (2, 8, 3)
    with pytest.raises(InputError, match="expected rows from the top down"):
        read_image(tmp_path / f"{order}.hdr")


def save_radiance(path: Path, header: str) -> None:
    """Save 2 x 3 pixels of red 1, green 0.5, blue 0.25, before the lines of the header are applied."""
    text = f"#?RADIANCE\n{header}FORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 3\n"
    path.write_bytes(text.encode() + bytes([128, 64, 32, 129]) * 6)


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("", (1, 0.5, 0.25)),
        ("EXPOSURE=          4.0\n", (0.25, 0.125, 0.0625)),
        ("EXPOSURE=4\nSOFTWARE=a\nEXPOSURE=.5\n", (0.5, 0.25, 0.125)),
        ("COLORCORR= 2 1 0.5\nEXPOSURE=2\n", (0.25, 0.25, 0.25)),
        ("EXPOSURE = 2\n", (0.5, 0.25, 0.125)),
    ],
)
def test_radiance_pictures_are_read_in_their_own_unit(
    tmp_path: Path, header: str, expected: tuple[float, ...]
) -> None:
    save_radiance(tmp_path / "a.hdr", header)
    image = read_image(tmp_path / "a.hdr")
    assert image.dtype == np.float32
    assert np.array_equal(image, np.broadcast_to(np.array(expected, np.float32), (2, 3, 3)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "line",
    [
        *[
            f"EXPOSURE={value}"
            for value in ("0", "-1", "inf", "nan", "x", "", "1 2", "1 1 1", "1e40", "1e-50")
        ],
        *[f"COLORCORR={value}" for value in ("1 2", "1", "1 1 0")],
    ],
)
def test_radiance_pictures_without_a_unit_are_refused(tmp_path: Path, line: str) -> None:
    save_radiance(tmp_path / "a.hdr", f"{line}\n")
    refused(tmp_path / "a.hdr", f"expected one number after EXPOSURE=, three after .*, got '{line}'; save it")


@pytest.mark.parametrize(
    "header", ["PF\n4 2\n-1\n", "PF 4 2 -1.000000\n", "PF\n# made by hand\n4\n2\n-1e0\n"]
)
def test_pfm_headers_of_every_layout_are_read(tmp_path: Path, header: str) -> None:
    (tmp_path / "a.pfm").write_bytes(header.encode() + np.arange(24, dtype="<f4").tobytes())
    np.testing.assert_array_equal(
        read_image(tmp_path / "a.pfm"), np.arange(24, dtype=np.float32).reshape(2, 4, 3)[::-1]
    )


@pytest.mark.parametrize(
    ("header", "more", "message"),
    [
        ("PF\r\n4 2\r\n-1\r\n", 0, "lines that end in LF, got CR LF"),
        ("PF\n4 2\n-1\r\n", 0, "lines that end in LF, got CR LF"),
        ("PF4\n4 2\n-1\n", 8, "damaged"),
        ("PF\n4 2\n0\n", 0, "a scale such as -1, .* got '0'"),
        ("PF\n4 2\nnan\n", 0, "a scale such as -1, .* got 'nan'"),
        ("PF\n4 2\n-inf\n", 0, "a scale such as -1, .* got '-inf'"),
        ("PF\n4 2\n-1\n", 1, "expected 106 bytes, got 110"),
        ("PF\n4 2\n-1\n", -1, "expected 106 bytes, got 102"),
        ("Pf\n4 2\n-1\n", 0, "expected 42 bytes, got 106"),
    ],
)
def test_pfm_files_that_would_read_as_another_picture_are_refused(
    tmp_path: Path, header: str, more: int, message: str
) -> None:
    (tmp_path / "a.pfm").write_bytes(header.encode() + bytes(4 * (4 * 2 * 3 + more)))
    refused(tmp_path / "a.pfm", message)


@pytest.mark.parametrize("suffix", [".hdr", ".pfm"])
def test_a_file_of_another_format_than_its_name_says_is_refused(tmp_path: Path, suffix: str) -> None:
    save(tmp_path / "a.exr", *"RGB")
    (tmp_path / "a.exr").rename(tmp_path / f"a{suffix}")
    refused(tmp_path / f"a{suffix}", f"expected {suffix} data, got openexr; rename it")


@pytest.mark.parametrize("suffix", [".hdr", ".pfm"])
def test_pictures_of_few_bits_are_no_radiance(tmp_path: Path, suffix: str) -> None:
    write_image(tmp_path / "a.png", np.ones((3, 4, 3), np.float32))
    (tmp_path / "a.png").rename(tmp_path / f"a{suffix}")
    with pytest.raises(InputError, match="no linear radiance"):
        read_image(tmp_path / f"a{suffix}")


def test_pictures_of_other_formats_are_to_be_converted(tmp_path: Path) -> None:
    (tmp_path / "a.tif").touch()
    refused(tmp_path / "a.tif", r"expected linear radiance as \.exr, \.pfm, \.hdr; .* oiiotool IN\.tif -o")


@pytest.mark.parametrize("count", [333, 341])
def test_a_part_of_more_channels_than_an_output_may_have_is_refused(tmp_path: Path, count: int) -> None:
    """OpenImageIO itself reads 341 layers of three channels, but not what is added to them."""
    names = [f"layer{index}.{name}" for index in range(count) for name in "RGB"]
    save(tmp_path / "p.exr", *"RGB", *names)
    refused(tmp_path / "p.exr", "expected at most 1000 channels in one part, got more; leave out layers")


def test_layers_without_end_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_parts(tmp_path / "p.exr", **{f"layer{i}": {n: pixels(i) for n in "RGB"} for i in range(4)})
    assert len(image_file.read_parts(tmp_path / "p.exr")) == 4
    monkeypatch.setattr(image_file, "_MOST_BYTES", 3 * 3 * 4 * WIDTH * HEIGHT)
    with pytest.raises(InputError, match="GiB of pixels, got more"):
        image_file.read_parts(tmp_path / "p.exr")
