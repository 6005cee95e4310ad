"""Image files: decoded without loss into channels of their own pixel type, and back.

OpenImageIO decodes: it checks headers against the size of the file before it allocates, and reports errors
where OpenEXR's module prints them. OpenEXR reads and writes EXR headers, whose attributes it keeps in their
own types.
"""

from __future__ import annotations

import io
import logging
import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR
import OpenImageIO as oiio  # noqa: N813 (the name that its documentation uses)

from tungsten_dip.buffers.atomic import check_suffix, is_utf8, replacing
from tungsten_dip.buffers.exr_header import escaped, read_headers
from tungsten_dip.buffers.render_buffers import TRAITS, FloatArray, Quantity, as_float32, check_array
from tungsten_dip.buffers.source import Channel, Part
from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError

_LOG = logging.getLogger(__name__)

RADIANCE_SUFFIXES = (".exr", ".pfm", ".hdr")
"""Formats that hold linear radiance, in the order of preference."""

_CONVERTIBLE_SUFFIXES = (".tif", ".tiff")
"""Formats that may hold linear radiance, or a picture for display: which, the file does not say."""

MAX_PIXELS = 2**28
"""The largest image read: 16384 x 16384. One channel of it is 1 GiB of float32."""

MOST_HDR = np.nextafter(np.float32(2.0**127), np.float32(0))
"""The largest value that .hdr holds: encoders turn what the exponent of RGBE does not reach into black."""

_MOST_BYTES = 16 << 30
"""The most that all parts of a file may hold: zeros take a thousandth of it on disk."""

MOST_CHANNELS = 1000
"""The most of a part that is to be denoised. OpenImageIO reads 1024 of an output, which has more."""

_RADIANCE_SCALES = {b"EXPOSURE": 1, b"COLORCORR": 3}
"""Lines of a .hdr header that say what the pixels have been multiplied by, and how many numbers each has."""

_FORMATS = {".exr": "openexr", ".pfm": "pnm", ".hdr": "hdr"}
"""OpenImageIO's names of the formats."""

_PFM_HEADER = re.compile(rb"(P[Ff])@(\d+)@(\d+)@(\S+)\s".replace(b"@", rb"(?:\s|#[^\n]*\n)+"))
"""Kind, width, height, scale, between them white space and comments."""

_LONGEST_PFM_HEADER = 1 << 12

_THREAD_POOL = Lock()
"""OpenEXR's is that of the process: of two who change its size, neither could restore it."""

_PNG_END = b"IEND\xae\x42\x60\x82"

# What the encoder decides anew, or what describes the encoding alone. An ACES container is uncompressed and
# has no layers (SMPTE ST 2065-4).
_ENCODING = {
    "acesImageContainerFlag",
    "channels",
    "chunkCount",
    "compression",
    "lineOrder",
    "name",
    "tiles",
    "type",
    "version",
}


def radiance_suffixes(quantity: Quantity) -> tuple[str, ...]:
    """Return the formats that hold a quantity, in the order of preference: .hdr holds no sign."""
    return tuple(suffix for suffix in RADIANCE_SUFFIXES if suffix != ".hdr" or not TRAITS[quantity].signed)


def with_known_suffix(path: Path, suffixes: tuple[str, ...] = RADIANCE_SUFFIXES) -> Path:
    """Return where a file that a scene names is written: with the first suffix if it has none of these."""
    return path if path.suffix.lower() in suffixes else path.with_suffix(suffixes[0])


def read_parts(path: Path) -> tuple[Part, ...]:
    """Read every part of an .exr file, or the one image of a .pfm or .hdr file. Mipmaps are left out.

    Raises InputError if the file is missing, no such image, deep, truncated or larger than MAX_PIXELS.
    """
    if is_folder(path):
        raise InputError(f"{path}: expected an image, this is a folder; name a file in it")
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the name")
    if path.suffix.lower() not in RADIANCE_SUFFIXES:
        expected = f"{path}: expected linear radiance as {', '.join(RADIANCE_SUFFIXES)}"
        if path.suffix.lower() in _CONVERTIBLE_SUFFIXES:
            raise InputError(f"{expected}; if it is linear, use oiiotool IN{path.suffix} -o OUT.exr")
        raise InputError(f"{expected}; name such a file")
    try:
        return _decoded(path)
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(f"{path}: not enough memory to read it ({error}); free some, or crop it") from error
    except (RuntimeError, ValueError) as error:
        raise InputError(f"{path}: is damaged ({_one_line(str(error))}); render or copy it again") from error


def is_folder(path: Path) -> bool:
    """Return whether this is a folder. Raises InputError if that cannot be known, as of too long a name."""
    try:
        return path.is_dir()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def read_attributes(path: Path) -> dict[str, Any]:
    """Return the attributes of an .exr file that is there (of its first part, if of several).

    Raises InputError if it is damaged.
    """
    try:
        headers, _ = read_headers(checked_name(path))
        return headers[0]
    except (IndexError, OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{path}: is damaged ({_one_line(str(error))}); render or copy it again") from error


def first_pixel(path: Path) -> tuple[int, int] | None:
    """Return column and row of the first pixel of a readable .exr file (of its first part, if of several).

    None for a format that does not say where its pixels are.
    """
    if path.suffix.lower() != ".exr":
        return None
    column, row = read_attributes(path)["dataWindow"][0]
    return int(column), int(row)


def is_whole(path: Path) -> bool:
    """Whether every part of an .exr file that was written by rows can be read to its end, its last row."""
    image = oiio.ImageInput.open(checked_name(path))
    if image is None:
        oiio.geterror()  # is printed at exit otherwise
        return False
    try:
        part = 0
        while image.seek_subimage(part, 0):
            spec = image.spec()
            end = spec.y + spec.height
            if image.read_scanlines(part, 0, end - 1, end, 0, 0, spec.nchannels, "unknown") is None:
                return False
            part += 1
        return True
    finally:
        image.close()


def write_exr(path: Path, parts: Iterable[Part], threads: int | None = None) -> None:
    """Write the parts, every channel in its own pixel type, compressed without loss, whole or not at all.

    ``threads`` None compresses on every core. Attributes that EXR cannot hold are left out and logged. Raises
    InputError if the file cannot be written.
    """
    encoded = []
    for part in parts:
        header = _storable(part.attributes)
        header.update(type=OpenEXR.scanlineimage, compression=OpenEXR.ZIP_COMPRESSION)
        # OpenEXR turns the values of the dictionary it is given into objects of its own, hence the copy.
        channels = {name: np.ascontiguousarray(channel) for name, channel in part.channels.items()}
        encoded.append(OpenEXR.Part(header, channels, part.name))
    with (
        replacing(path) as temporary,
        temporary.open("wb") as stream,
        _compressing(thread_count(threads)),
    ):
        try:
            OpenEXR.File(encoded).write(stream)
        except (RuntimeError, ValueError) as error:
            reason = _one_line(str(error))
            raise InputError(
                f"{path}: OpenEXR cannot write this ({reason}); leave layers out of the input"
            ) from error


@contextmanager
def _compressing(threads: int) -> Iterator[None]:
    """Let OpenEXR use so many threads, for as long as it is needed: a process that forks must have none."""
    with _THREAD_POOL:
        before = OpenEXR.global_thread_count()
        OpenEXR.set_global_thread_count(threads)
        try:
            yield
        finally:
            OpenEXR.set_global_thread_count(before)


def write_image(path: str | Path, image: npt.NDArray[Any]) -> None:
    """Write one picture of shape (height, width, 1 or 3), whole or not at all.

    .exr and .pfm take linear radiance as float32, .hdr as RGBE; .png takes display-referred values in [0, 1]
    (clipped, 8 bit). Raises InputError if the suffix or the shape is another one, if these are no numbers
    or too large ones for float32, if they are integers for a .png or not all from 0 to MOST_HDR for a .hdr,
    or if the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    check_suffix(path, *RADIANCE_SUFFIXES, ".png")
    check_array(str(path), image)
    if image.ndim != 3 or image.shape[2] not in (1, 3) or image.size == 0:
        raise InputError(
            f"{path}: expected a picture of shape (height, width, 1 or 3), got {image.shape}; reshape it, or "
            f"choose channels"
        )
    if suffix == ".png" and image.dtype.kind in "iu":
        raise InputError(
            f"{path}: expected values from 0 to 1, got {image.dtype}; divide by 255 (of 16 bits, by 65535)"
        )
    image = as_float32(str(path), image)
    if suffix == ".exr":
        names = "RGB" if image.shape[2] == 3 else "Y"
        channels = {name: image[..., index] for index, name in enumerate(names)}
        write_exr(path, [Part(channels)])
        return
    if suffix == ".hdr":
        if not ((image >= 0) & (image <= MOST_HDR)).all():
            raise InputError(
                f"{path}: expected values from 0 to {MOST_HDR:.2g}, which .hdr holds, got "
                f"{image.min():.2g} to {image.max():.2g}; use .exr or .pfm"
            )
        image = np.broadcast_to(image, (*image.shape[:2], 3))
    height, width, count = image.shape
    spec = oiio.ImageSpec(width, height, count, "uint8" if suffix == ".png" else "float")
    spec["pnm:pfmflip"] = 1
    with replacing(path) as temporary:
        name = str(Path(checked_name(temporary.parent), temporary.name))
        output = oiio.ImageOutput.create(name)
        pixels = np.ascontiguousarray(image)
        if output is None:
            raise OSError(_one_line(oiio.geterror()))
        written = output.open(name, spec) and output.write_image(pixels)
        closed = output.close()
        # A full disk may show in the message alone: the PNG encoder then still claims success.
        message = output.geterror()
        if not (written and closed) or message:
            raise OSError(_one_line(message))
        # Or not at all: the last block is written by a close that reports no error.
        if not _is_complete(temporary):
            raise OSError("the end of the file is missing")


def _is_complete(path: Path) -> bool:
    """Whether a file that was just written, not an .exr, can be read to its end."""
    try:
        _decoded(path)
    except InputError:
        return False
    return path.suffix.lower() != ".png" or path.read_bytes().endswith(_PNG_END)


def checked_name(path: Path) -> str:
    """Return the path as OpenImageIO and OpenEXR take it. Raises InputError if the name is no UTF-8."""
    if not is_utf8(path):
        raise InputError(f"{path}: expected a name in UTF-8; rename it")
    return os.fsencode(path).decode()  # which differs from the text in a locale that is not UTF-8


def too_many_channels() -> str:
    """Return what is said of a part with more than `MOST_CHANNELS`."""
    return f"expected at most {MOST_CHANNELS} channels in one part, got more; leave out layers"


def _decoded(path: Path) -> tuple[Part, ...]:
    config = oiio.ImageSpec()
    config["pnm:pfmflip"] = 1  # rows of a .pfm are stored bottom up
    image = oiio.ImageInput.open(checked_name(path), config)
    if image is None:
        reason = _one_line(oiio.geterror())
        if "limits:channels" in reason:
            raise InputError(f"{path}: {too_many_channels()}")
        raise InputError(f"{path}: is no readable image ({reason}); render it again")
    try:
        parts: list[Part] = []
        size = 0
        while image.seek_subimage(len(parts), 0):
            size += image.spec().image_bytes(True)
            if size > _MOST_BYTES:
                raise InputError(
                    f"{path}: expected at most {_MOST_BYTES >> 30} GiB of pixels, got more; leave out layers"
                )
            parts.append(_part(path, image, len(parts)))
    finally:
        image.close()
    if path.suffix.lower() != ".exr":
        return tuple(parts)
    headers, left_out = read_headers(checked_name(path))
    for line in left_out:
        _LOG.warning("%s: %s", path, line)
    return tuple(
        Part(part.channels, {key: value for key, value in header.items() if key not in _ENCODING}, part.name)
        for part, header in zip(parts, headers, strict=True)
    )


def _part(path: Path, image: Any, index: int) -> Part:
    spec = image.spec()
    if spec.deep:
        raise InputError(f"{path}: holds deep pixels; expected one colour per pixel, flatten it first")
    if spec.width * spec.height > MAX_PIXELS:
        raise InputError(
            f"{path}: expected at most {MAX_PIXELS} pixels, got {spec.width} x {spec.height}; crop it first"
        )
    if spec.nchannels == 0:
        raise InputError(f"{path}: holds no channels; render it again")
    if path.suffix.lower() == ".hdr" and spec.get_int_attribute("Orientation", 1) != 1:
        raise InputError(
            f"{path}: expected rows from the top down, each from the left (-Y +X), got another order; turn "
            f"it with oiiotool IN.hdr --reorient -o OUT.hdr"
        )
    formats = [spec.channelformat(channel) for channel in range(spec.nchannels)]
    if path.suffix.lower() in RADIANCE_SUFFIXES and not {"uint8", "uint16"}.isdisjoint(map(str, formats)):
        raise InputError(f"{path}: holds no linear radiance but a picture of few bits; save it as .exr")
    suffix = path.suffix.lower()
    if image.format_name() != _FORMATS.get(suffix, image.format_name()):
        raise InputError(
            f"{path}: expected {suffix} data, got {image.format_name()}; rename it with its own suffix"
        )
    if suffix == ".pfm":
        _check_pfm(path)
    part_name, *names = _utf8_names(path, [spec.getattribute("oiio:subimagename") or "", *spec.channelnames])
    if len(set(names)) < len(names):
        raise InputError(f"{path}: expected channels of different names, got two of one name; rename one")
    channels: dict[str, Channel] = {}
    begin = 0
    while begin < spec.nchannels:
        # One call per run of equal pixel types: a mixed call would convert all to one type.
        end = next((c for c in range(begin, spec.nchannels) if formats[c] != formats[begin]), spec.nchannels)
        pixels = image.read_image(index, 0, begin, end, formats[begin])
        if pixels is None:
            raise InputError(
                f"{path}: is damaged or truncated ({_one_line(image.geterror())}); render or copy it again"
            )
        if path.suffix.lower() == ".hdr":
            pixels = pixels / _radiance_scale(path)
        planes = np.ascontiguousarray(np.moveaxis(pixels, -1, 0))
        channels.update(zip(names[begin:end], planes, strict=True))
        begin = end
    return Part(channels, name=part_name)


def _utf8_names(path: Path, names: Sequence[str]) -> list[str]:
    """Return names with bytes escaped that are not UTF-8: no file can be written with them."""
    utf8 = [escaped(name.encode(errors="surrogateescape")) for name in names]
    renamed = [new for new, old in zip(utf8, names, strict=True) if new != old]
    if renamed:
        _LOG.warning("%s: expected names in UTF-8: renamed %s", path, ", ".join(renamed))
    return utf8


def _check_pfm(path: Path) -> None:
    """Check what OpenImageIO takes as it comes: the header, and that the pixels are all that follows it.

    The pixels are multiplied by the scale without its sign, which stands for the order of their bytes.
    """
    with path.open("rb") as file:
        begin = file.read(_LONGEST_PFM_HEADER)
    header = _PFM_HEADER.match(begin)
    if header is None:
        raise InputError(f"{path}: is damaged (expected PF or Pf, a size and a scale); render it again")
    if b"\r" in header[0]:
        raise InputError(f"{path}: expected lines that end in LF, got CR LF; write or copy it in binary mode")
    kind, width, height, scale = header.groups()
    smallest, largest = _float32_range()
    try:
        magnitude = abs(float(scale))
    except ValueError:
        magnitude = math.nan
    if not smallest < magnitude < largest:
        raise InputError(
            f"{path}: expected a scale such as -1, finite and not 0, got {scale.decode('latin-1')!r:.40}; "
            f"correct it, or save as .exr"
        )
    expected = header.end() + int(width) * int(height) * 4 * (3 if kind == b"PF" else 1)
    if (length := path.stat().st_size) != expected:
        raise InputError(
            f"{path}: is damaged or truncated (expected {expected} bytes, got {length}); render or copy it "
            f"again"
        )


def _radiance_scale(path: Path) -> FloatArray:
    """Return what the red, green and blue of a readable .hdr file have been multiplied by.

    The product of all EXPOSURE and COLORCORR lines of the header (Ward, "Radiance File Formats"), which
    OpenImageIO leaves to the reader.
    """
    scale = [1.0, 1.0, 1.0]
    smallest, largest = _float32_range()
    with path.open("rb") as file:
        for line in file:
            name, _, text = line.partition(b"=")
            if not name.strip():  # the end of the header
                break
            count = _RADIANCE_SCALES.get(name.strip())
            if count is None:
                continue
            try:
                values = [float(value) for value in text.split()]
            except ValueError:
                values = []
            if len(values) == count:
                scale = [s * v for s, v in zip(scale, values * (3 // count), strict=True)]
            if len(values) != count or not all(smallest < s < largest for s in scale):
                raise InputError(
                    f"{path}: expected one number after EXPOSURE=, three after COLORCORR=, above 0 and in "
                    f"the range of float32, got {line.decode('latin-1').strip()!r:.60}; save it as .exr"
                )
    return np.array(scale, np.float32)


def _float32_range() -> tuple[float, float]:
    return float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)


def _storable(attributes: dict[str, Any]) -> dict[str, Any]:
    kept = {}
    for name, value in attributes.items():
        if name in _ENCODING:
            continue
        try:
            pixel = {"Y": np.zeros((1, 1), np.float32)}
            if name not in ("dataWindow", "displayWindow"):
                file = io.BytesIO()
                OpenEXR.File({name: value, "type": OpenEXR.scanlineimage}, pixel).write(file)
                file.seek(0)
                # OpenEXR leaves out some lists, and cuts integers to 32 bits, without an error.
                stored = OpenEXR.File(file, header_only=True).header().get(name)
                if stored is None or (isinstance(value, int) and stored != value):
                    raise ValueError(
                        f"expected an integer of 32 bits, or a list of strings or floats, got {value!r:.40}"
                    )
            kept[name] = value
        except (RuntimeError, TypeError, ValueError) as error:
            _LOG.warning("attribute %s is left out: %s", name, _one_line(str(error)))
    return kept


def _one_line(message: str) -> str:
    return next((line.strip() for line in message.splitlines() if line.strip()), "no reason given")
