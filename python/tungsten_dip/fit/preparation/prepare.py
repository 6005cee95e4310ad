"""What every fit and every model does with its input first, and with its result at the end."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tungsten_dip import _core
from tungsten_dip.buffers.half_buffers import (
    without_foreign_halves,
    without_foreign_variance,
    without_single_halves,
)
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers
from tungsten_dip.buffers.sanitize import sanitize
from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError, check_type
from tungsten_dip.fit.preparation.splitting import with_lost_halves_drawn
from tungsten_dip.fit.result import FitResult

_LOG = logging.getLogger(__name__)

_GAP_RADII = (2, 1)
"""Radii of the windows whose samples fill a gap; the smaller one, where it has any, tells surfaces apart."""

_LARGEST_ALBEDO = 1.1
"""Albedo of a surface: 1, and what the lobes of a pixel filter add. Percent and 8 bits are far above."""

_SEEN_LIGHT = np.float32(1 / 3)
"""Part of a lamp's radiance that the colour contains at least; fog or a lens that darkens takes the rest."""

_UNSEEN_SHARE = 0.1
"""Part of an albedo that may be above that without such light. In renders, mirrors make it 0.03 at most, and
of an albedo twice as large it is above 0.1 on most images."""


@dataclass(frozen=True)
class Prepared:
    """Sanitised buffers, and notes on repaired values."""

    buffers: RenderBuffers
    notes: tuple[str, ...]


def prepare_input(buffers: RenderBuffers, threads: int | None) -> Prepared:
    """Check and sanitise the input; ``threads`` None uses every core.

    An albedo in another scale and a variance of something else are left out, halves that are lost are drawn,
    and gaps between samples are filled.

    Raises InputError if these are no buffers or the image is empty.
    """
    check_type("buffers", buffers, RenderBuffers, "read_buffers reads them from files")
    if buffers.color.mean.size == 0:
        raise InputError(f"expected an image of at least one pixel, got {buffers.width}x{buffers.height}")
    if not any(np.isfinite(plane).any() for _, plane in buffers.color.planes()):
        _LOG.warning(
            "the colour is NaN or Inf in every pixel: the result will be nearly empty; render it again"
        )
    threads = thread_count(threads)
    buffers, single = without_single_halves(buffers)
    buffers, foreign = without_foreign_halves(buffers)
    rendered = buffers.color
    buffers, repaired = sanitize(buffers, threads)
    buffers = _without_albedo_of_another_scale(buffers)
    buffers, lost = _without_lost_halves(buffers, rendered, threads)
    buffers, gaps = _with_gaps_filled(buffers, threads)
    buffers, variance = without_foreign_variance(buffers, threads)
    return Prepared(buffers, (*single, *foreign, *repaired, *lost, *gaps, *variance))


def _with_gaps_filled(buffers: RenderBuffers, threads: int) -> tuple[RenderBuffers, tuple[str, ...]]:
    """Return sanitised buffers with gaps between samples filled, and a note if there are any.

    Renderers leave pixels without a sample black, which is nothing that a sample found. They get the mean of
    the pixels around that have some. Areas without a sample, of 5x5 pixels or more, were not rendered: they
    stay as they are.
    """
    spp = buffers.spp
    if not isinstance(spp, np.ndarray) or spp.all():
        return buffers, ()
    sampled = (spp > 0).astype(np.float32)
    outside = (_core.box_mean(sampled, _GAP_RADII[0], threads) == 0).astype(np.float32)
    gaps = (spp == 0) & (_core.box_mean(outside, _GAP_RADII[0], threads) == 0)
    count = np.count_nonzero(gaps)
    if count == 0:
        return buffers, ()

    def filled(image: FloatImage) -> FloatImage:
        for radius in _GAP_RADII:
            share = _core.box_mean(sampled, radius, threads)
            around = _core.box_mean(image * sampled, radius, threads) / np.maximum(share, np.float32(1e-3))
            image = np.where(gaps & (share > 0), around, image)
        return image

    quantities = {
        name: Buffer(**{plane: filled(image) for plane, image in buffer.planes()})
        for name, buffer in buffers.quantities()
    }
    alpha = None if buffers.alpha is None else filled(buffers.alpha)
    note = f"{count} of {gaps.size} pixels have no sample: they are filled with the mean of those around them"
    return replace(buffers.with_quantities(**quantities), alpha=alpha), (note,)


def _without_lost_halves(
    buffers: RenderBuffers, rendered: Buffer, threads: int
) -> tuple[RenderBuffers, tuple[str, ...]]:
    """Return sanitised buffers with halves drawn where a half is lost, and a note if there are such pixels.

    ``rendered`` is the colour before it was sanitised. There one half alone is left, or the mean alone.
    Copies of it would confirm all of its noise, and neighbouring pixels have less noise than it. Lamps, which
    are equal in both halves, stay as they are: nothing of them is lost.
    """
    color = buffers.color
    if color is rendered or rendered.halves is None or color.halves is None:
        return buffers, ()
    known, known_a, known_b = (_finite(image) for image in (rendered.mean, *rendered.halves))
    # A renderer may also have left out of the mean what it could not compute.
    alone_a, alone_b = (
        ~known | (rendered.mean == half).all(axis=2, keepdims=True) for half in rendered.halves
    )
    only_a, only_b = known_a & ~known_b & alone_a, known_b & ~known_a & alone_b
    lost = only_a | only_b | (known & ~known_a & ~known_b)
    count = np.count_nonzero(lost)
    if count == 0:
        return buffers, ()
    half_a, half_b = color.halves
    mean = np.where(only_a, half_a, np.where(only_b, half_b, color.mean))
    if count == lost.size:
        note = "half buffers are lost in every pixel"
        return buffers.with_quantities(color=Buffer(mean)), (note,)
    buffers = buffers.with_quantities(color=replace(color, mean=mean))
    note = (
        f"half buffers are lost in {count} of {lost.size} pixels: the noise of what is left there, estimated "
        "from the surrounding pixels, is split at random into two"
    )
    return with_lost_halves_drawn(buffers, lost, threads), (note,)


def _finite(image: FloatImage) -> npt.NDArray[np.bool_]:
    """Return in which pixels every channel is finite, shape (height, width, 1)."""
    largest = np.abs(image).max(axis=2, keepdims=True)
    finite: npt.NDArray[np.bool_] = largest < np.float32(_core.INFINITE_RADIANCE)
    return finite


def _without_albedo_of_another_scale(buffers: RenderBuffers) -> RenderBuffers:
    """Return buffers without an albedo that is above 1 in many pixels whose colour shows no such light.

    Above 1 it would be taken for emission. Of a lamp or an environment it is the radiance, which the colour
    contains; of surfaces in percent, or in 8 bits, it is not.
    """
    color = buffers.color.mean
    if buffers.albedo is None or not color.any():  # black shows nothing of the albedo
        return buffers
    albedo = buffers.albedo.mean
    unseen = (albedo > _LARGEST_ALBEDO) & (color > 0) & (color < _SEEN_LIGHT * albedo)
    if np.count_nonzero(unseen) <= _UNSEEN_SHARE * np.count_nonzero(albedo):
        return buffers
    _LOG.warning(
        "the albedo is left out: expected 0 to 1, linear, got values up to %.3g; rescale it, or use --map "
        "albedo=none",
        albedo.max(),
    )
    return buffers.with_quantities(albedo=None)


def finish_result(result: FitResult, prepared: Prepared) -> FitResult:
    """Return the result with the notes on its input before its own, all of which are logged.

    Where alpha and colour of the input are 0 the result and its halves are black: radiance without coverage
    would glow around the image that it is composited over.
    """
    result = replace(result, notes=(*prepared.notes, *result.notes))
    for note in result.notes:
        _LOG.info(note)
    alpha = prepared.buffers.alpha
    if alpha is None:
        return result
    empty = (alpha <= 0) & (prepared.buffers.color.mean == 0).all(axis=2, keepdims=True)

    def blackened(image: FloatImage) -> FloatImage:
        return np.where(empty, np.float32(0), image)

    halves = result.halves
    if halves is not None:
        halves = blackened(halves[0]), blackened(halves[1])
    return replace(result, color=blackened(result.color), halves=halves)
