"""Checks estimates of the clean image that the caller supplies."""

from __future__ import annotations

from collections.abc import Sequence, Sized

import numpy as np

from tungsten_dip.buffers.render_buffers import Halves, RenderBuffers, check_array
from tungsten_dip.errors import InputError, check_type


def checked_candidates(buffers: RenderBuffers, candidates: Sequence[Halves]) -> tuple[Halves, ...]:
    """Return the candidates as float32.

    Raises InputError if one is not a pair of images of the colour's shape, or holds NaN or Inf.
    """
    check_type("candidates", candidates, Sequence, "give a list of pairs of images")
    checked = []
    for index, pair in enumerate(candidates):
        checked.append(_checked_pair(f"candidate {index}", pair, buffers))
        for name, image in zip("AB", checked[-1], strict=True):
            if not np.isfinite(image).all():
                raise InputError(
                    f"candidate {index}, half {name}: expected finite radiance, found NaN or Inf"
                )
    return tuple(checked)


def checked_previous(buffers: RenderBuffers, previous: Halves | None) -> Halves | None:
    """Return the previous frame's halves as float32, NaN where they have no value.

    Raises InputError if they are not a pair of images of the colour's shape.
    """
    return None if previous is None else _checked_pair("previous", previous, buffers)


def _checked_pair(what: str, pair: Halves, buffers: RenderBuffers) -> Halves:
    if not (isinstance(pair, Sized) and len(pair) == 2):
        got = len(pair) if isinstance(pair, Sized) else type(pair).__name__
        raise InputError(f"{what}: expected a pair of images, one per half, got {got}")
    expected = buffers.color.mean.shape
    for name, image in zip("AB", pair, strict=True):
        check_array(f"{what}, half {name}", image)
        if image.shape != expected:
            raise InputError(
                f"{what}, half {name}: expected shape {expected} as the colour has it, got {image.shape}"
            )
    with np.errstate(over="ignore"):
        a, b = (np.ascontiguousarray(image, np.float32) for image in pair)
    return a, b
