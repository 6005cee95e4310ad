"""Tungsten's textures as Mitsuba's.

Tungsten's v points up in a bitmap where Mitsuba's points down, its gamma of 2.2 rounds down to 8 bits, and a
bitmap without interpolation ignores its scale: all of that is kept.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any, Literal

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import OpenImageIO

from tungsten_dip.buffers.image_file import MAX_PIXELS, RADIANCE_SUFFIXES, checked_name
from tungsten_dip.errors import InputError
from tungsten_dip.hosts.mitsuba.scene_builder import Node, SceneBuilder, constant, transform_uv
from tungsten_dip.scene.types import (
    BitmapTexture,
    BladeTexture,
    CheckerTexture,
    ConstantTexture,
    DiskTexture,
    Matrix,
    Primitive,
    Skydome,
    Texture,
    Vec3,
)

_LOG = logging.getLogger(__name__)

Request = Literal["rgb", "average", "alpha_or_average"]
"""What is asked of a texture: its colour, the mean of it, or its alpha channel where it has one."""

UV = np.eye(3)
"""A shape whose UV are the same in both renderers; else a 3x3 matrix from Mitsuba's UV to Tungsten's."""

_Texels = npt.NDArray[np.float32]

_GAMMA = (np.floor(255.0 * (np.arange(256) / 255.0) ** 2.2 + 1e-9) / 255.0).astype(np.float32)
_ALWAYS_WITH_ALPHA = {".png", ".jpg", ".jpeg"}  # Tungsten decodes these to four channels, whatever they hold
_SHAPE_RESOLUTION = 1024  # of the bitmaps that stand for disk and blade textures


def texture_node(
    builder: SceneBuilder,
    texture: Texture,
    request: Request = "rgb",
    uv: Matrix = UV,
    scale: float = 1.0,
    least: float = -math.inf,
) -> Any:
    """Return the Mitsuba texture of a Tungsten texture times ``scale``, as `mitsuba.load_dict` takes it.

    No texel is below ``least``. A bitmap that is used more than once is the same object. Numbers
    ("average", "alpha_or_average") have one channel, colours three.

    Raises InputError for a type of texture without counterpart and for an image that cannot be read.
    """
    if isinstance(texture, ConstantTexture):
        return constant(_requested(texture.value, request, scale, least))
    if isinstance(texture, CheckerTexture):
        on, off = (
            constant(_requested(color, request, scale, least))
            for color in (texture.on_color, texture.off_color)
        )
        # Mitsuba's checkerboard swaps its two colours when it is asked for a number.
        first, second = (off, on) if request == "rgb" else (on, off)
        squares = np.diag([texture.res_u / 2, texture.res_v / 2, 1.0]) @ uv
        return {
            "type": "checkerboard",
            "color0": first,
            "color1": second,
            "to_uv": transform_uv(squares),
        }
    if isinstance(texture, BitmapTexture):
        factor = scale * texture.scale if texture.interpolate else 1.0
        return _bitmap_object(builder, texture, request, uv, factor, least)
    if isinstance(texture, DiskTexture | BladeTexture):
        mask = coverage(texture, _SHAPE_RESOLUTION)
        value = np.atleast_1d(np.asarray(_requested(texture.value, request, scale, least)))
        return _bitmap_node(np.maximum(mask[:, :, None] * value, least), uv, clamp=True, nearest=False)
    raise builder.unsupported(f"a texture of type {texture.kind}")


def slopes_node(builder: SceneBuilder, texture: Texture) -> Node:
    """Return the texture of three channels that "tungsten_bump" expects of a height map.

    Tungsten repeats every height map and scales each.

    Raises InputError for anything but a bitmap, and for an image that cannot be read.
    """
    if not isinstance(texture, BitmapTexture):
        raise builder.unsupported(f"bump mapping by a texture of type {texture.kind}")
    heights = bitmap_pixels(builder, texture, "average")[:, :, 0] * texture.scale
    across, down = (np.roll(heights, -1, axis) - np.roll(heights, 1, axis) for axis in (1, 0))
    slopes = np.stack((across, down, np.zeros_like(heights)), axis=2)
    return _bitmap_node(slopes, UV, clamp=False, nearest=True)


def is_constant(texture: Texture) -> bool:
    """Whether a texture is one colour everywhere."""
    return isinstance(texture, ConstantTexture)


def largest_value(builder: SceneBuilder, texture: Texture) -> float:
    """Return the largest component anywhere in a texture."""
    if isinstance(texture, ConstantTexture | DiskTexture | BladeTexture):
        return max(texture.value)
    if isinstance(texture, CheckerTexture):
        return max(*texture.on_color, *texture.off_color)
    if isinstance(texture, BitmapTexture):
        return float(bitmap_pixels(builder, texture, "rgb").max()) * texture.scale
    raise builder.unsupported(f"a texture of type {texture.kind}")


def mean_value(builder: SceneBuilder, texture: Texture) -> float:
    """Return the mean over a texture that `largest_value` knows, of the channel in which it is largest."""
    if isinstance(texture, ConstantTexture):
        return max(texture.value)
    if isinstance(texture, DiskTexture | BladeTexture):
        return float(coverage(texture, _SHAPE_RESOLUTION).mean()) * max(texture.value)
    if isinstance(texture, CheckerTexture):
        pairs = zip(texture.on_color, texture.off_color, strict=True)
        return max(0.5 * (max(on, 0.0) + max(off, 0.0)) for on, off in pairs)
    if isinstance(texture, BitmapTexture):
        light = np.maximum(bitmap_pixels(builder, texture, "rgb"), 0.0)
        return float(light.mean(axis=(0, 1), dtype=np.float64).max()) * texture.scale
    raise builder.unsupported(f"a texture of type {texture.kind}")


def shines(builder: SceneBuilder, primitive: Primitive) -> bool:
    """Whether a primitive is a light that brings any."""
    if isinstance(primitive, Skydome):
        return primitive.intensity > 0.0
    return primitive.emitter is not None and largest_value(builder, primitive.emitter) > 0.0


def bitmap_pixels(builder: SceneBuilder, texture: BitmapTexture, request: Request) -> _Texels:
    """Return the texels as Tungsten holds them, without scale.

    Shape (height, width, 3 or 1), row 0 at the top.
    """
    key = ("pixels", str(texture.file), request, texture.gamma_correct)
    texels: _Texels | None = builder.made(key)
    return builder.remember(key, _read_texels(texture, request)) if texels is None else texels


def coverage(texture: DiskTexture | BladeTexture, resolution: int) -> npt.NDArray[np.float64]:
    """Return the share of every texel that lies within the disk or the polygon, row 0 at the top."""
    centres = (np.arange(resolution) + 0.5) / resolution * 2.0 - 1.0
    x, y = np.meshgrid(centres, -centres)
    if isinstance(texture, DiskTexture):
        inwards = 1.0 - np.hypot(x, y)
    else:
        # The middle of the polygon's edge that faces (x, y) lies at cos(pi / blades) from the centre.
        half = math.pi / texture.blades
        phi = (np.arctan2(y, x) - texture.angle) % (2 * half) - half
        inwards = math.cos(half) - np.hypot(x, y) * np.cos(phi)
    return np.asarray(np.clip(inwards * resolution / 2 + 0.5, 0.0, 1.0))


def _requested(value: Vec3, request: Request, scale: float, least: float) -> Vec3 | float:
    r, g, b = (max(component * scale, least) for component in value)
    # A number is the first component of a constant in Tungsten, not the mean.
    return (r, g, b) if request == "rgb" else r


def _bitmap_object(
    builder: SceneBuilder, texture: BitmapTexture, request: Request, uv: Matrix, scale: float, least: float
) -> Any:
    settings = (request, texture.gamma_correct, texture.clamp, texture.interpolate, scale, least)
    key = ("texture", str(texture.file), *settings, uv.tobytes().hex())
    found = builder.made(key)
    if found is None:
        pixels = bitmap_pixels(builder, texture, request)
        if scale != 1.0 or least > -math.inf:
            pixels = np.maximum(pixels * np.float32(scale), np.float32(least))
        node = _bitmap_node(pixels, uv, clamp=texture.clamp, nearest=not texture.interpolate)
        found = builder.remember(key, mi.load_dict(node))
    return found


def _bitmap_node(pixels: npt.NDArray[np.floating[Any]], uv: Matrix, *, clamp: bool, nearest: bool) -> Node:
    height, width = pixels.shape[:2]
    # Mitsuba wants two texels each way.
    pixels = np.repeat(np.repeat(pixels, 2 if height < 2 else 1, axis=0), 2 if width < 2 else 1, axis=1)
    flip_v = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 1.0]])
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(pixels, dtype=np.float32)),
        "raw": True,
        "format": "variant",
        "filter_type": "nearest" if nearest else "bilinear",
        "wrap_mode": "clamp" if clamp else "repeat",
        "to_uv": transform_uv(flip_v @ uv),
    }


def _read_texels(texture: BitmapTexture, request: Request) -> _Texels:
    hdr = texture.file.suffix.lower() in RADIANCE_SUFFIXES
    config = OpenImageIO.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    image = OpenImageIO.ImageInput.open(checked_name(texture.file), config)
    if image is None:
        reason = " ".join(OpenImageIO.geterror().split())
        raise InputError(f"{texture.file}: expected an image for a texture ({reason}); check the file")
    spec = image.spec()
    if spec.width * spec.height * spec.nchannels > 4 * MAX_PIXELS:
        image.close()
        raise InputError(
            f"{texture.file}: expected a texture of at most {MAX_PIXELS} pixels in 4 channels, "
            f"got {spec.width} x {spec.height} in {spec.nchannels}; make it smaller"
        )
    pixels = image.read_image("float" if hdr else "uint8")
    error, alpha_channel = image.geterror(), spec.alpha_channel
    image.close()
    if pixels is None or error:
        raise InputError(
            f"{texture.file}: the image is damaged ({' '.join(error.split())}); replace the file"
        )
    pixels = np.asarray(pixels)
    pixels = pixels[:, :, None] if pixels.ndim == 2 else pixels
    channels = pixels.shape[2]
    alpha: Any = pixels[:, :, alpha_channel : alpha_channel + 1] if alpha_channel >= 0 else None
    rgb: Any
    if texture.file.suffix.lower() == ".exr":
        rgb = _rgb_from_exr(texture, pixels, spec.channelnames)
    else:
        rgb = pixels[:, :, :3] if channels >= 3 else np.repeat(pixels[:, :, :1], 3, axis=2)
    texels: Any
    if request == "rgb":
        texels = rgb if hdr else _GAMMA[rgb] if texture.gamma_correct else rgb / np.float32(255)
    elif request == "alpha_or_average" and alpha is not None:
        texels = alpha / np.float32(1 if hdr else 255)
    elif request == "alpha_or_average" and texture.file.suffix.lower() in _ALWAYS_WITH_ALPHA:
        _LOG.warning("%s: holds no alpha: as in Tungsten, nothing of it is transparent", texture.file)
        texels = np.ones((*pixels.shape[:2], 1))
    else:
        mean = rgb.sum(axis=2, keepdims=True, dtype=np.float32) / np.float32(3)
        texels = mean if hdr else np.floor(mean) / np.float32(255)
    texels = np.asarray(texels, np.float32)
    if lost := np.count_nonzero(~np.isfinite(texels)):
        _LOG.warning("%s: %d values are not finite, and taken for 0", texture.file, lost)
        texels = np.where(np.isfinite(texels), texels, 0)
    return np.asarray(texels, np.float32)


def _rgb_from_exr(texture: BitmapTexture, pixels: _Texels, names: Sequence[str]) -> _Texels:
    """Return the channels that Tungsten takes: R, G and B, black where one is missing, or Y."""
    if known := [name for name in "RGB" if name in names]:
        rgb: _Texels = np.zeros((*pixels.shape[:2], 3), np.float32)
        for name in known:
            rgb[:, :, "RGB".index(name)] = pixels[:, :, names.index(name)]
        return rgb
    if "Y" in names:
        return np.stack([pixels[:, :, names.index("Y")]] * 3, axis=2)
    raise InputError(
        f"{texture.file}: expected a texture with channels R, G, B or Y, got {', '.join(names)}; rename them"
    )
