"""The data model: the buffers of one image, as numpy arrays.

Arrays are float32, C-contiguous, shape (height, width, channels), row 0 at the top. Colour is linear
radiance, normals are in world space with components in [-1, 1], depth is a distance along the ray (0 where it
left the scene).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from tungsten_dip.errors import InputError, check_type

if TYPE_CHECKING:
    from tungsten_dip.buffers.source import Source

FloatImage = npt.NDArray[np.float32]

Halves = tuple[FloatImage, FloatImage]
"""Made of half A of the samples, and the same made of half B: as a rule images, always of one shape."""

FloatArray = npt.NDArray[np.float32]
"""Numbers of any shape that is not an image's."""

Indices = npt.NDArray[np.int64]
"""Indices of pixels, counted row by row."""

Quantity = Literal["color", "albedo", "normal", "depth", "visibility"]


@dataclass(frozen=True)
class Traits:
    """What a quantity is.

    ``channels`` are the names of its channels in a layer of ours. ``layers`` are the names that renderers
    give to its layer, in lower case, best first; the empty one is the top level. Features guide a fit. What
    is ``signed`` may be negative.
    """

    channels: str
    layers: tuple[str, ...]
    is_feature: bool = False
    signed: bool = False


TRAITS: dict[Quantity, Traits] = {
    "color": Traits(
        "RGB", ("noisy image", "noisy", "color", "", "rgba", "beauty", "combined", "ci", "c", "image")
    ),
    "albedo": Traits(
        "RGB",
        (
            "denoising albedo",
            "denoising_albedo",
            "denoise_albedo",
            "albedo",
            "diffuse_albedo",
            "diffcol",
            "diffuse color",
            "diffusefilter",
            "vraydiffusefilter",
        ),
        is_feature=True,
    ),
    "normal": Traits(
        "XYZ",
        (
            "denoising normal",
            "denoising_normal",
            "n_noice",
            "normal",
            "normals",
            "avg_shading_normal",
            "shading_normal",
            "sh_normal",
            "ns",
            "nn",
            "n",
        ),
        is_feature=True,
        signed=True,
    ),
    "depth": Traits(
        "Y", ("denoising depth", "denoising_depth", "z_noice", "depth", "dd.y", "dd", "z"), is_feature=True
    ),
    # No feature: one random shadow ray a sample is as noisy as the colour.
    "visibility": Traits("Y", ("visibility",)),
}
"""Every quantity that a renderer may write."""

CHANNELS: dict[Quantity, int] = {quantity: len(traits.channels) for quantity, traits in TRAITS.items()}
"""The number of its channels."""

FEATURES: tuple[Quantity, ...] = tuple(quantity for quantity, traits in TRAITS.items() if traits.is_feature)
"""The quantities that guide a fit."""

MOST_SPP = 2**31 - 1
"""Renderers count in 32 bits."""

_AS_ARRAY = "use numpy.asarray(image, numpy.float32)"


@dataclass(frozen=True, eq=False)
class Buffer:
    """One quantity of an image: its mean over all samples and, where known, its halves and its variance.

    ``half_a`` and ``half_b`` are the means of two disjoint halves of the samples; ``variance`` is the
    variance of ``mean`` (not of one sample). All have the shape of ``mean``.

    Raises InputError if one is no array of numbers (`check_array`).
    """

    mean: FloatImage
    half_a: FloatImage | None = None
    half_b: FloatImage | None = None
    variance: FloatImage | None = None

    def __post_init__(self) -> None:
        for name, plane in (("mean", self.mean), *self.planes()):
            check_array(name, plane)

    @property
    def halves(self) -> Halves | None:
        """Both halves, None unless both are known."""
        return None if self.half_a is None or self.half_b is None else (self.half_a, self.half_b)

    @property
    def halves_or_mean(self) -> Halves:
        """Both halves, or the mean in place of either."""
        return self.halves or (self.mean, self.mean)

    def planes(self) -> Iterator[tuple[str, FloatImage]]:
        """Yield (name, array) for every array that is known, in the order of the fields."""
        for plane in fields(self):
            array = getattr(self, plane.name)
            if array is not None:
                yield plane.name, array


@dataclass(frozen=True, eq=False)
class RenderBuffers:
    """Everything a renderer outputs for one image.

    ``spp`` is the number of samples per pixel, one number or shape (height, width, 1) where it varies (0 in
    pixels without a sample). ``alpha`` has shape (height, width, 1). ``attributes`` is metadata of the source
    that travels to the output, ``source`` the channels of the file that was read, in their own pixel types,
    for the same purpose. Its file holds exactly these images and samples: ``source`` becomes None if one of
    them is another than the one that was read, as after `dataclasses.replace`.

    Raises InputError if a quantity is no Buffer, the shapes or the channel counts do not fit together, an
    array is not C-contiguous float32, or ``spp`` is neither a number above 0 nor an array of such and 0.
    """

    color: Buffer
    albedo: Buffer | None = None
    normal: Buffer | None = None
    depth: Buffer | None = None
    visibility: Buffer | None = None
    spp: float | FloatImage | None = None
    alpha: FloatImage | None = None
    attributes: dict[str, Any] = field(default_factory=dict)
    source: Source | None = None

    def __post_init__(self) -> None:
        for quantity, buffer in (("color", self.color), *self.quantities()):
            check_type(quantity, buffer, Buffer, "use Buffer(array)")
        if self.alpha is not None:
            check_array("alpha", self.alpha)
        if isinstance(self.spp, Real):
            if not 0 < self.spp <= MOST_SPP:
                raise InputError(f"spp: expected a number above 0, {MOST_SPP} at most, got {self.spp!r:.40}")
            object.__setattr__(self, "spp", float(self.spp))  # numpy's numbers are no attributes of files
        elif self.spp is not None:
            check_array("spp", self.spp, "use a number, or an array where it varies")
        size = self.color.mean.shape[:2]
        for quantity, buffer in self.quantities():
            for plane, array in buffer.planes():
                _check(f"{quantity} {plane}", array, size, CHANNELS[quantity])
        for name, more in (("alpha", self.alpha), ("spp", self.spp)):
            if isinstance(more, np.ndarray):
                _check(name, more, size, 1)
        if isinstance(self.spp, np.ndarray) and not are_counts(self.spp):
            raise InputError(f"spp: expected numbers from 0 to {MOST_SPP} alone; use None if it is not known")
        if self.source and any(
            _differs(getattr(self, name), self.source.read.get(name)) for name in (*CHANNELS, "alpha", "spp")
        ):
            object.__setattr__(self, "source", None)

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.color.mean.shape[0])

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.color.mean.shape[1])

    def get(self, quantity: Quantity) -> Buffer | None:
        """Return a quantity's buffer, None if it is not known."""
        buffer: Buffer | None = getattr(self, quantity)
        return buffer

    def quantities(self) -> Iterator[tuple[Quantity, Buffer]]:
        """Yield (name, buffer) for every quantity that is known."""
        for quantity in CHANNELS:
            buffer = self.get(quantity)
            if buffer is not None:
                yield quantity, buffer

    def with_quantities(self, **buffers: Buffer | None) -> RenderBuffers:
        """Return a copy with some quantities replaced, and without ``source``.

        What is kept for longer, such as the previous frame, does not keep all layers of its file in memory.
        """
        return replace(self, source=None, **buffers)  # type: ignore[arg-type]


def mean_of(halves: Halves) -> FloatImage:
    """Return the mean of both halves."""
    mean: FloatImage = np.float32(0.5) * (halves[0] + halves[1])
    return mean


def variance_of_mean(halves: Halves) -> FloatImage:
    """Return the variance of `mean_of`, as halves with independent noise show it: (A - B)^2 / 4, unbiased."""
    variance: FloatImage = np.float32(0.25) * (halves[0] - halves[1]) ** 2
    return variance


def _differs(now: object, read: object) -> bool:
    """Whether this is another image, or another number."""
    if isinstance(now, (int, float)) and isinstance(read, (int, float)):
        return now != read
    return now is not read


def check_array(what: str, array: Any, remedy: str = _AS_ARRAY) -> None:
    """Raise InputError if this is no array of real numbers, or one with a mask, which nothing here heeds."""
    check_type(what, array, np.ndarray, remedy)
    if isinstance(array, np.ma.MaskedArray):
        raise InputError(f"{what}: expected an array without a mask, got MaskedArray; use .filled(0)")
    if array.dtype.kind not in "biuf":
        raise InputError(f"{what}: expected real numbers, got {array.dtype}; {remedy}")


def are_counts(spp: FloatImage) -> bool:
    """Whether every pixel's number of samples is possible; 0 is."""
    return bool(((spp >= 0) & (spp <= MOST_SPP)).all())


def as_float32(what: str, array: npt.NDArray[Any]) -> FloatImage:
    """Return real numbers as float32 in C order. Raises InputError if some are too large for it."""
    try:
        with np.errstate(over="raise"):
            return array.astype(np.float32, order="C", copy=False)
    except FloatingPointError:
        raise InputError(f"{what}: expected values up to 3e38 (float32), got larger ones; scale it") from None


def _check(what: str, array: FloatImage, size: tuple[int, ...], channels: int) -> None:
    if array.dtype != np.float32:
        raise InputError(f"{what}: expected float32, got {array.dtype}; use .astype(np.float32)")
    if array.ndim != 3 or array.shape[2] != channels:
        raise InputError(
            f"{what}: expected shape (height, width, {channels}), got {array.shape}; "
            f"{_channels_remedy(array.shape, channels)}"
        )
    if array.shape[:2] != size:
        raise InputError(
            f"{what}: expected shape {(*size, channels)} as the colour has it, got {array.shape}; render all "
            f"buffers at one size"
        )
    if not (array.flags.c_contiguous and array.flags.aligned):
        raise InputError(f"{what}: expected aligned rows one after the other in memory; use .copy()")


def _channels_remedy(shape: tuple[int, ...], channels: int) -> str:
    if channels == 1 and len(shape) == 2:
        return "image[..., None] adds the axis of channels"
    if channels == 3 and (len(shape) == 2 or shape[2:] == (1,)):
        return "numpy.dstack([image] * 3) makes three channels of one"
    if channels == 3 and shape[2:] == (4,):
        return "use image[..., :3].copy(), and image[..., 3:].copy() as alpha"
    return "give one image, its channels on the last axis"
