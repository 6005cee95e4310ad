"""Results into files."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from importlib import metadata
from pathlib import Path

import numpy as np

from tungsten_dip.buffers.atomic import check_suffix
from tungsten_dip.buffers.render_buffers import FloatImage, RenderBuffers, as_float32, check_array
from tungsten_dip.buffers.source import Channel
from tungsten_dip.buffers.write import write_layers
from tungsten_dip.errors import InputError, check_type
from tungsten_dip.fit.result import FitResult

_LOG = logging.getLogger(__name__)

_MOST_LOST = 0.01
"""The part of an image that half floats may lose: too little to be seen. Rounding loses 1 / 2048 at most."""


def write_denoised(
    path: str | Path, result: FitResult, buffers: RenderBuffers, float16: bool = False
) -> None:
    """Write the denoised picture together with the buffers it was made from (`buffers.write`).

    With ``float16``, the picture and the error are stored as 16 bit floats, unless their values are too large
    or too small for that. Settings, seed, seconds, iterations, the estimated relMSE and the version become
    attributes.

    Raises InputError if the file is no .exr or cannot be written, or the result is none, of another size than
    the buffers, or no numbers; an existing file then stays as it was.
    """
    check_type("result", result, FitResult, "give what denoise returned, not its image alone")
    check_type("buffers", buffers, RenderBuffers, "give those that the result was made from")
    check_suffix(Path(path), ".exr")
    layers = {"": _stored("the picture", _checked("color", result.color, buffers, 3), float16)}
    if result.error is not None:
        layers["error"] = _stored("the error", _checked("error", result.error, buffers, 1), float16)
    facts = {
        "version": metadata.version("tungsten-dip"),
        "seed": str(result.settings.seed),
        "settings": json.dumps(asdict(result.settings)),
        "seconds": result.seconds,
        "iterations": result.iterations,
    }
    if result.estimated_relmse is not None:
        facts["estimated_relmse"] = result.estimated_relmse
    write_layers(Path(path), layers, facts, buffers, result.settings.threads)


def _checked(name: str, image: FloatImage, buffers: RenderBuffers, channels: int) -> FloatImage:
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
