"""Repairs values that no renderer can have meant, before anything is computed from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tungsten_dip import _core
from tungsten_dip.buffers.render_buffers import Buffer, FloatImage, RenderBuffers

_PLANES = ("", " half A", " half B", " variance")


def sanitize(buffers: RenderBuffers, threads: int) -> tuple[RenderBuffers, tuple[str, ...]]:
    """Repair NaN, infinite and negative values; return buffers and a log line per repaired quantity.

    No radiance below 1e36 is clamped. Negative values become 0 (normals may be negative; a depth that is
    negative everywhere changes its sign), and so does an infinite depth (1e9 and more), which marks the sky.
    The energy of a filter's negative lobes is taken from the radiance around, so that the mean is preserved.
    Everything else, also normals of 1e6 and an albedo of 1e12 and more, is rebuilt: the mean and the halves
    from one another, a variance from the halves, and what remains from the valid pixels around it or, far
    from any, from the half that is valid. Of alpha, NaN and Inf alone are repaired (`finite_alpha`). Arrays
    without defects are shared with ``buffers``, which are not modified.
    """
    repaired: dict[str, Buffer | None] = {}
    lines = []
    if buffers.depth is not None and (depth := with_depth_ahead(buffers.depth)) is not buffers.depth:
        buffers = buffers.with_quantities(depth=depth)
        lines.append("changed the sign of the depth, which was negative everywhere")
    for quantity, buffer in buffers.quantities():
        planes, defects = _core.sanitize(
            quantity, buffer.mean, buffer.half_a, buffer.half_b, buffer.variance, threads
        )
        found = [
            f"{quantity}{plane} {_counts(counts)}"
            for plane, counts in zip(_PLANES, defects, strict=True)
            if _counts(counts)
        ]
        if found:
            repaired[quantity] = Buffer(*planes)
            lines.append(f"repaired {'; '.join(found)}")
    if buffers.alpha is not None:
        alpha, found_in_alpha = finite_alpha(buffers.alpha, threads)
        if found_in_alpha:
            buffers = replace(buffers, alpha=alpha)
            lines.append(f"repaired alpha {found_in_alpha}")
    return buffers.with_quantities(**repaired), tuple(lines)


def finite_alpha(alpha: FloatImage, threads: int) -> tuple[FloatImage, str]:
    """Return an alpha, shape (height, width, 1), rebuilt where it is NaN or infinite, and how many values.

    1e6 and more counts as infinite. What a filter's lobes leave below 0 or above 1 stays. Without defects,
    ``alpha`` itself is returned, and an empty text.
    """
    # The rules of normals hold for it, too.
    (finite, *_), (defects, *_) = _core.sanitize("normal", alpha, None, None, None, threads)
    return finite, _counts(defects)


def with_depth_ahead(depth: Buffer) -> Buffer:
    """Return a depth with the opposite sign if it is negative wherever something is seen, else as it is.

    It is then a coordinate in the space of a camera that looks along the negative axis.
    """
    known = depth.mean[(np.abs(depth.mean) < _core.INFINITE_DEPTH) & (depth.mean != 0)]
    if known.size == 0 or not (known < 0).all():
        return depth
    ahead = {name: plane if name == "variance" else -plane for name, plane in depth.planes()}
    return Buffer(**ahead)


def _counts(defects: _core.Defects) -> str:
    counts = {"NaN": defects.nan, "infinite": defects.infinite, "negative": defects.negative}
    return ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
