"""What every way to denoise an image does with its input first, and with its notes at the end."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tungsten_dip.buffers.model import Halves, RenderBuffers
from tungsten_dip.buffers.sanitize import sanitize
from tungsten_dip.errors import InputError
from tungsten_dip.fit.candidates import checked_candidates, checked_previous
from tungsten_dip.fit.settings import FitResult

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Prepared:
    """Sanitised buffers, what somebody else knows of the image, and notes on what was mended."""

    buffers: RenderBuffers
    candidates: tuple[Halves, ...]
    previous: Halves | None
    notes: tuple[str, ...]


def prepared(
    buffers: RenderBuffers,
    candidates: Sequence[Halves] = (),
    previous: Halves | None = None,
    threads: int | None = None,
) -> Prepared:
    """Check and mend what is to be denoised; the arguments are those of `tungsten_dip.denoise`.

    Raises InputError if the image is empty, or candidates are of another shape or not finite.
    """
    if buffers.color.mean.size == 0:
        raise InputError(f"expected an image of at least one pixel, got {buffers.width}x{buffers.height}")
    if not any(np.isfinite(plane).any() for _, plane in buffers.color.planes()):
        _LOG.warning(
            "the colour is NaN or Inf in every pixel: the picture will show next to nothing; render it again"
        )
    given = checked_candidates(buffers, candidates)
    previous = checked_previous(buffers, previous)
    buffers, mended = sanitize(buffers, threads)
    return Prepared(buffers, given, previous, mended)


def with_notes(result: FitResult, notes: Sequence[str]) -> FitResult:
    """Return the result with ``notes`` before its own, all of which are logged."""
    result = replace(result, notes=(*notes, *result.notes))
    for note in result.notes:
        _LOG.info(note)
    return result
