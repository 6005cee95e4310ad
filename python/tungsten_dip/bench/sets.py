"""Sets to measure on: saved buffers and a reference for their denoised image."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tungsten_dip.buffers.read import read_buffers, read_image
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.errors import InputError

REFERENCE = "reference.exr"
NFOR = "nfor.exr"

CROP_MULTIPLE = 32
"""The published code crops images to multiples of this, two to the number of its network's scales."""


@dataclass(frozen=True)
class BenchSet:
    """Noisy buffers and their reference, linear radiance of shape (height, width, 3).

    ``name`` is made of the last two parts of the path. ``nfor`` is what Tungsten's own denoiser made of these
    buffers, where that was saved beside them. ``digest`` identifies all values.
    """

    name: str
    buffers: RenderBuffers
    reference: FloatImage
    nfor: FloatImage | None
    digest: str


def read_sets(texts: Sequence[str], mapping: Mapping[str, str] | None = None) -> list[BenchSet]:
    """Read every ``INPUT`` or ``INPUT=REFERENCE``.

    ``INPUT`` is whatever `read_buffers` takes, with the same ``mapping`` for all. Where no reference is
    named, it is the file ``reference.exr`` in the folder of the buffers or the folder above.

    Raises InputError if a file cannot be read, there is no reference, its size or that of NFOR's image is
    another one, or two sets have one name.
    """
    sets = [_read_set(text, mapping) for text in texts]
    names = [each.name for each in sets]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{name}: two sets end in that path; rename a folder, or measure them apart")
    return sets


def cropped_as_published(bench_set: BenchSet) -> BenchSet:
    """Return the middle of a set, its sides multiples of `CROP_MULTIPLE`, under a name of its own.

    Raises InputError if a side is too short.
    """
    height, width = bench_set.reference.shape[:2]
    if min(height, width) < CROP_MULTIPLE:
        raise InputError(
            f"crop: expected sides from {CROP_MULTIPLE} pixels on, got {bench_set.name} with "
            f"{width} x {height}; measure it whole"
        )
    spare_rows, spare_columns = height % CROP_MULTIPLE, width % CROP_MULTIPLE
    top, left = spare_rows // 2, spare_columns // 2
    part = slice(top, top + height - spare_rows), slice(left, left + width - spare_columns)
    return _bench_set(
        f"{bench_set.name} cropped",
        cropped(bench_set.buffers, part),
        bench_set.reference[part],
        None if bench_set.nfor is None else bench_set.nfor[part],
    )


def cropped(buffers: RenderBuffers, part: tuple[slice, slice]) -> RenderBuffers:
    """Return rows and columns of what a fit sees: every plane of every quantity, alpha and the samples."""
    quantities: dict[str, Any] = {
        name: Buffer(**{plane: np.ascontiguousarray(values[part]) for plane, values in buffer.planes()})
        for name, buffer in buffers.quantities()
    }
    spp = np.ascontiguousarray(buffers.spp[part]) if isinstance(buffers.spp, np.ndarray) else buffers.spp
    alpha = None if buffers.alpha is None else np.ascontiguousarray(buffers.alpha[part])
    return RenderBuffers(**quantities, spp=spp, alpha=alpha)


def _read_set(text: str, mapping: Mapping[str, str] | None) -> BenchSet:
    path, reference_path = _paths(text)
    buffers, reference = read_buffers(path, mapping), read_image(reference_path)
    _check_size(reference_path, reference, path, buffers)
    if not np.isfinite(reference).all():
        raise InputError(f"{reference_path}: expected a finite reference, got NaN or Inf; render it again")
    nfor_path = _folder(path) / NFOR
    nfor = read_image(nfor_path) if nfor_path.exists() else None
    if nfor is not None:
        _check_size(nfor_path, nfor, path, buffers)
    resolved = path.resolve()
    name = "/".join((resolved.parent.name, resolved.stem)).lstrip("/")
    return _bench_set(name, buffers, reference, nfor)


def _check_size(image_path: Path, image: FloatImage, path: Path, buffers: RenderBuffers) -> None:
    if image.shape != buffers.color.mean.shape:
        raise InputError(
            f"{image_path}: expected the size of {path}, {buffers.width} x {buffers.height} with 3 channels, "
            f"got {image.shape[1]} x {image.shape[0]} with {image.shape[2]}"
        )


def _bench_set(name: str, buffers: RenderBuffers, reference: FloatImage, nfor: FloatImage | None) -> BenchSet:
    planes = (
        (quantity + plane, image)
        for quantity, buffer in buffers.quantities()
        for plane, image in buffer.planes()
    )
    more = (("alpha", buffers.alpha), ("spp", buffers.spp), ("reference", reference), ("nfor", nfor))
    digest = hashlib.sha256()
    for what, value in (*planes, *more):
        if value is not None:
            digest.update(what.encode() + np.asarray(value).tobytes())
    return BenchSet(name, buffers, reference, nfor, digest.hexdigest()[:12])


def _paths(text: str) -> tuple[Path, Path]:
    """Take apart ``INPUT=REFERENCE``, where both exist if names have more ``=``; what exists is an input."""
    parts = text.split("=")
    pairs = [(Path("=".join(parts[:i])), Path("=".join(parts[i:]))) for i in range(1, len(parts))]
    if pairs and not Path(text).exists():
        return next((pair for pair in pairs if all(path.exists() for path in pair)), pairs[-1])
    folder = _folder(Path(text))
    for candidate in (folder / REFERENCE, folder.resolve().parent / REFERENCE):
        if candidate.exists():
            return Path(text), candidate
    raise InputError(
        f"{text}: no reference to measure against; save one as {folder / REFERENCE}, or name one as "
        f"{text}=REFERENCE.exr"
    )


def _folder(path: Path) -> Path:
    return path if path.is_dir() else path.parent
