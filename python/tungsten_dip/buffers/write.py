"""Results and buffers into files.

A denoised EXR holds, in one file:

- R, G, B (and A, in which only NaN and Inf are repaired) at the top level: the denoised picture, float32 or
  float16;
- layer ``error``: the estimated squared relative error of every pixel, where known;
- every channel of the input bit for bit, in its own pixel type. Input channels whose names are taken (in
  upper or lower case, and a grey picture's) move to the layer ``noisy``; the parts of a multi-part input
  follow the part with the picture as they were;
- attributes: those of the input, and our own, which begin with ``tungsten_dip/``.

``read_buffers`` undoes this, so that a denoised file can be denoised again.
"""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from tungsten_dip.buffers.atomic import check_suffix
from tungsten_dip.buffers.image_file import RADIANCE_SUFFIXES, write_exr
from tungsten_dip.buffers.layers import PLANES
from tungsten_dip.buffers.render_buffers import (
    CHANNELS,
    TRAITS,
    FloatImage,
    RenderBuffers,
    as_float32,
    check_array,
)
from tungsten_dip.buffers.sanitize import finite_alpha
from tungsten_dip.buffers.source import ADDED, FRAME, MAP, MOVED_TO, OWN, SPP, Channel, Part, Source
from tungsten_dip.errors import InputError, check_type

_LOG = logging.getLogger(__name__)

_MOST_LOST = 0.01
"""The part of an image that half floats may lose: too little to be seen. Rounding loses 1 / 2048 at most."""

_DENOISED_PART = "tungsten_dip denoised"

_GREY = ("Y",)
"""Channels of a picture that must not be in one layer with another one's red, green and blue."""


@runtime_checkable
class Denoised(Protocol):
    """The part of the result of a fit that is saved."""

    @property
    def color(self) -> FloatImage:
        """Linear radiance, shape (height, width, 3)."""

    @property
    def error(self) -> FloatImage | None:
        """Estimated squared relative error, shape (height, width, 1)."""

    @property
    def settings(self) -> Any:
        """A dataclass with fields ``seed`` and ``threads``."""

    @property
    def seconds(self) -> float:
        """Duration of the fit."""

    @property
    def iterations(self) -> int:
        """Number of training steps."""

    @property
    def estimated_relmse(self) -> float | None:
        """The mean of ``error``."""


def write_denoised(path: str | Path, result: Denoised, buffers: RenderBuffers, float16: bool = False) -> None:
    """Write the denoised picture together with the buffers it was made from (see the top of this file).

    With ``float16``, the picture and the error are stored as 16 bit floats, unless their values are too large
    or too small for that. Settings, seed, seconds, iterations, the estimated relMSE and the version become
    attributes.

    Raises InputError if the file is no .exr or cannot be written, or the result is none, of another size than
    the buffers, or no numbers; an existing file then stays as it was.
    """
    path = Path(path)
    check_suffix(path, ".exr")
    check_type("result", result, Denoised, "give what denoise returned, not its image alone")
    check_type("buffers", buffers, RenderBuffers, "give those that the result was made from")
    color = _of_result("color", result.color, buffers, 3)
    source = buffers.source or _source_from_buffers(buffers)
    added: dict[str, Channel] = _channels("", "RGB", _stored("the picture", color, float16))
    if result.error is not None:
        error = _of_result("error", result.error, buffers, 1)
        added |= _channels("error.", "Y", _stored("the error", error, float16))
    single = len(source.parts) == 1
    kept = source.parts[0].channels if single else {}
    if buffers.alpha is not None:
        alpha, defects = finite_alpha(buffers.alpha, result.settings.threads)
        if defects or "A" not in kept:
            added["A"] = alpha[..., 0]
    moved_to = "noisy"
    while any(name.startswith(moved_to + ".") for name in kept):
        moved_to += "_"
    taken = {name.upper() for name in (*added, *_GREY)}
    kept = {f"{moved_to}.{name}" if name.upper() in taken else name: plane for name, plane in kept.items()}
    own: dict[str, Any] = {
        OWN + "version": metadata.version("tungsten-dip"),
        OWN + "seed": str(result.settings.seed),
        OWN + "settings": json.dumps(asdict(result.settings)),
        OWN + "seconds": result.seconds,
        OWN + "iterations": result.iterations,
        ADDED: sorted(added),
        MOVED_TO: moved_to,
        MAP: json.dumps(dict(source.mapping)),
    }
    if result.estimated_relmse is not None:
        own[OWN + "estimated_relmse"] = result.estimated_relmse
    own |= _spp(buffers)
    attributes = {**_frame(buffers), **buffers.attributes, **own}
    if single:
        parts = [Part(added | kept, attributes, source.parts[0].name)]
    else:
        name = _DENOISED_PART
        while any(part.name == name for part in source.parts):
            name += "_"
        parts = [Part(added, attributes, name), *source.parts]
    write_exr(path, parts, result.settings.threads)


def write_error_map(path: Path, error: FloatImage, buffers: RenderBuffers) -> None:
    """Write the error of a result, shape (height, width, 1), as float32, with the buffers' data window.

    Raises InputError if the file cannot be written.
    """
    write_exr(path, [Part(_channels("", "Y", error), _frame(buffers))])


def write_tungsten_folder(folder: str | Path, buffers: RenderBuffers) -> None:
    """Write buffers as Tungsten names them (``color.exr``, ``colorA.exr``, ...), as float32.

    The folder is made if need be. The colour comes last: a set cut short cannot be mistaken for a whole one.

    Raises InputError if the folder cannot be written or holds buffers that this set would not replace.
    """
    folder = Path(folder)
    frame = _frame(buffers)
    files: dict[str, Part] = {}
    for quantity, buffer in buffers.quantities():
        names = "RGB" if CHANNELS[quantity] == 3 else "Y"
        for field, plane in buffer.planes():
            files[quantity + PLANES[field]] = Part(_channels("", names, plane), frame)
    channels = dict(files.pop("color").channels)
    if buffers.alpha is not None:
        channels["A"] = buffers.alpha[..., 0]
    if isinstance(buffers.spp, np.ndarray):
        channels["spp.Y"] = buffers.spp[..., 0]
    files["color"] = Part(channels, {**frame, **buffers.attributes, **_spp(buffers)})
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stale = [
            file.name
            for file in folder.iterdir()
            if file.suffix.lower() in RADIANCE_SUFFIXES
            and file.stem in (q + suffix for q in CHANNELS for suffix in PLANES.values())
            and not (file.suffix == ".exr" and file.stem in files)
        ]
    except OSError as problem:
        raise InputError(f"{folder}: cannot be written ({problem.strerror}); choose another") from problem
    if stale:
        raise InputError(f"{folder}: holds {stale[0]} of another render; remove it or choose another folder")
    for name, part in files.items():
        write_exr(folder / f"{name}.exr", [part])


def _source_from_buffers(buffers: RenderBuffers) -> Source:
    """Layers for buffers that never were a file."""
    channels: dict[str, Channel] = {}
    for quantity, buffer in buffers.quantities():
        for field, plane in buffer.planes():
            channels |= _channels(f"{quantity}{PLANES[field]}.", TRAITS[quantity].channels, plane)
    if buffers.alpha is not None:
        channels["color.A"] = buffers.alpha[..., 0]
    if isinstance(buffers.spp, np.ndarray):
        channels["spp.Y"] = buffers.spp[..., 0]
    return Source((Part(channels),))


def _frame(buffers: RenderBuffers) -> dict[str, Any]:
    """Return where the pixels were in the file that was read, if any."""
    source = buffers.source
    attributes = source.parts[source.color_part].attributes if source else {}
    return {key: value for key, value in attributes.items() if key in FRAME}


def _channels(prefix: str, names: str, image: Channel) -> dict[str, Channel]:
    return {prefix + name: image[..., index] for index, name in enumerate(names)}


def _of_result(name: str, image: FloatImage, buffers: RenderBuffers, channels: int) -> FloatImage:
    """Return an image of a result, which may have been graded in another type, as float32."""
    check_array(f"result {name}", image)
    expected = (buffers.height, buffers.width, channels)
    if image.shape != expected:
        raise InputError(
            f"result {name}: expected shape {expected} as the buffers have it, got {image.shape}; give the "
            f"buffers that it was made from"
        )
    return as_float32(f"result {name}", image)


def _stored(label: str, image: FloatImage, float16: bool) -> Channel:
    if not float16:
        return image
    finite = image[np.isfinite(image)]
    with np.errstate(over="ignore"):
        lost = np.abs(finite.astype(np.float16) - finite).sum(dtype=np.float64)
    if lost > _MOST_LOST * np.abs(finite).sum(dtype=np.float64):
        _LOG.warning(
            "%s has values that half floats cannot hold (beyond 65504, or mostly below 6e-8): stored as "
            "float32",
            label,
        )
        return image
    return image.astype(np.float16)


def _spp(buffers: RenderBuffers) -> dict[str, float]:
    return {SPP: float(buffers.spp)} if isinstance(buffers.spp, (int, float)) else {}
