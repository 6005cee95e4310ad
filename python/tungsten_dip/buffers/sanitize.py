"""Repairs values that no renderer can have meant, before anything is computed from them."""

from __future__ import annotations

from tungsten_dip import _core
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.cores import thread_count

_PLANES = ("", " half A", " half B", " variance")


def sanitize(buffers: RenderBuffers, threads: int | None = None) -> tuple[RenderBuffers, tuple[str, ...]]:
    """Repair NaN, infinite and negative values; return buffers and a log line per repaired quantity.

    No radiance below 1e36 is clamped. Negative values become 0 (normals may be negative), and so does an
    infinite depth (1e9 and more), which marks the sky. The energy of a filter's negative lobes is taken from
    the radiance around, so that the mean is preserved. Everything else, also normals of 1e6 and an albedo of
    1e12 and more, is rebuilt: the mean and the halves from one another, a variance from the halves, and what
    remains from the valid pixels around it or, far from any, from the half that is valid. Arrays without
    defects are shared with ``buffers``, which are not modified. ``threads`` None uses every core.
    """
    repaired: dict[str, Buffer | None] = {}
    lines = []
    for quantity, buffer in buffers.quantities():
        planes, defects = _core.sanitize(
            quantity, buffer.mean, buffer.half_a, buffer.half_b, buffer.variance, thread_count(threads)
        )
        found = [
            f"{quantity}{plane} {_counts(counts)}"
            for plane, counts in zip(_PLANES, defects, strict=True)
            if _counts(counts)
        ]
        if found:
            repaired[quantity] = Buffer(*planes)
            lines.append(f"repaired {'; '.join(found)}")
    return buffers.with_quantities(**repaired), tuple(lines)


def _counts(defects: _core.Defects) -> str:
    counts = {"NaN": defects.nan, "infinite": defects.infinite, "negative": defects.negative}
    return ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
