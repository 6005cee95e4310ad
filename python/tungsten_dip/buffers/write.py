"""Buffers into files, with or without images that were made of them.

A denoised EXR (`write_layers`) holds, in one file:

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
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tungsten_dip.buffers.atomic import check_suffix
from tungsten_dip.buffers.image_file import RADIANCE_SUFFIXES, write_exr
from tungsten_dip.buffers.layers import PLANES
from tungsten_dip.buffers.render_buffers import (
    CHANNELS,
    TRAITS,
    FloatImage,
    RenderBuffers,
)
from tungsten_dip.buffers.sanitize import finite_alpha
from tungsten_dip.buffers.source import ADDED, FRAME, MAP, MOVED_TO, OWN, SPP, Channel, Part, Source
from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError

_DENOISED_PART = "tungsten_dip denoised"

_GREY = ("Y",)
"""Channels of a picture that must not be in one layer with another one's red, green and blue."""


def write_layers(
    path: Path,
    layers: Mapping[str, Channel],
    facts: Mapping[str, Any],
    buffers: RenderBuffers,
    threads: int | None = None,
) -> None:
    """Write images together with the buffers they were made from (see the top of this file).

    ``layers`` are images of shape (height, width, 1 or 3) by the names of their layers; the empty name is the
    top level, the picture's. ``facts`` become attributes of our own. ``threads`` None uses every core.

    Raises InputError if the file is no .exr or cannot be written; an existing file then stays as it was.
    """
    check_suffix(path, ".exr")
    source = buffers.source or _source_from_buffers(buffers)
    added: dict[str, Channel] = {}
    for layer, image in layers.items():
        names = "RGB" if image.shape[2] == 3 else "Y"
        added |= _channels(f"{layer}." if layer else "", names, image)
    single = len(source.parts) == 1
    kept = source.parts[0].channels if single else {}
    if buffers.alpha is not None:
        alpha, defects = finite_alpha(buffers.alpha, thread_count(threads))
        if defects or "A" not in kept:
            added["A"] = alpha[..., 0]
    moved_to = "noisy"
    while any(name.startswith(moved_to + ".") for name in kept):
        moved_to += "_"
    taken = {name.upper() for name in (*added, *_GREY)}
    kept = {f"{moved_to}.{name}" if name.upper() in taken else name: plane for name, plane in kept.items()}
    own = {
        **{OWN + name: value for name, value in facts.items()},
        ADDED: sorted(added),
        MOVED_TO: moved_to,
        MAP: json.dumps(dict(source.mapping)),
        **_spp(buffers),
    }
    attributes = {**_frame(buffers), **buffers.attributes, **own}
    if single:
        parts = [Part(added | kept, attributes, source.parts[0].name)]
    else:
        name = _DENOISED_PART
        while any(part.name == name for part in source.parts):
            name += "_"
        parts = [Part(added, attributes, name), *source.parts]
    write_exr(path, parts, threads)


def write_error_map(path: Path, error: FloatImage, buffers: RenderBuffers, threads: int | None) -> None:
    """Write the error of a result, shape (height, width, 1), as float32, with the buffers' data window.

    ``threads`` None uses every core.

    Raises InputError if the file cannot be written.
    """
    write_exr(path, [Part(_channels("", "Y", error), _frame(buffers))], threads)


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
    attributes = buffers.source.main.attributes if buffers.source else {}
    return {key: value for key, value in attributes.items() if key in FRAME}


def _channels(prefix: str, names: str, image: Channel) -> dict[str, Channel]:
    return {prefix + name: image[..., index] for index, name in enumerate(names)}


def _spp(buffers: RenderBuffers) -> dict[str, float]:
    return {SPP: float(buffers.spp)} if isinstance(buffers.spp, (int, float)) else {}
