"""Fits: from noisy buffers to a clean image. Importing this does not import torch; `denoise` does."""

from __future__ import annotations

import logging
from dataclasses import replace
from importlib.util import find_spec

from tungsten_dip.buffers.model import RenderBuffers
from tungsten_dip.buffers.sanitize import sanitize
from tungsten_dip.errors import InputError
from tungsten_dip.fit.settings import FitResult, FitSettings, HistoryPoint
from tungsten_dip.progress import Progress, silent

_LOG = logging.getLogger(__name__)

__all__ = ["FitResult", "FitSettings", "HistoryPoint", "denoise", "require_torch"]


def require_torch() -> None:
    """Raise InputError if torch is not installed, without importing it: a render may come before the fit."""
    if find_spec("torch") is None:
        raise InputError("fitting needs torch; install it with: pip install 'tungsten-dip[fit]'")


def denoise(
    buffers: RenderBuffers, settings: FitSettings | None = None, progress: Progress = silent
) -> FitResult:
    """Denoise one image, fitting a network to it and to nothing else.

    ``buffers`` hold linear radiance of any exposure; they are sanitised first, and only the colour is
    required. The result is linear radiance of the same shape, finite everywhere. The same buffers, settings,
    threads and machine give the same bits. Ctrl-C during the training of the network ends it early with what
    was reached.

    Raises InputError if the image is empty, a buffer that the settings ask for is missing, or torch is.
    """
    settings = settings or FitSettings()
    if buffers.color.mean.size == 0:
        raise InputError(f"expected an image of at least one pixel, got {buffers.width}x{buffers.height}")
    require_torch()
    buffers, mended = sanitize(buffers, settings.threads)
    if settings.preset == "paper":
        from tungsten_dip.fit.paper import fit_paper as fit
    else:
        from tungsten_dip.fit.fusion import fit_fusion as fit
    result = fit(buffers, settings, progress)
    result = replace(result, notes=(*mended, *result.notes))
    for note in result.notes:
        _LOG.info(note)
    return result
