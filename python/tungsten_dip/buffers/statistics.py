"""Whether the noise of a render's halves is independent."""

from __future__ import annotations

from tungsten_dip import _core
from tungsten_dip._core import HalvesTest
from tungsten_dip.buffers.model import RenderBuffers
from tungsten_dip.cores import thread_count

__all__ = ["HalvesTest", "halves_independent"]


def halves_independent(buffers: RenderBuffers, threads: int | None = None) -> HalvesTest:
    """Test whether the noise of the colour's halves is independent, as scoring one by the other assumes.

    Halves of a low-discrepancy sampler mirror each other (Tungsten's Sobol sampler: correlation -0.2), and
    halves may be copies of one image. The correlation is taken of what a second-order difference leaves of
    both halves; where texture makes it positive, the sample variance decides, if it is known. Without
    halves, and where nothing in the image tells, ``independent`` is False. Expects sanitised buffers.
    """
    color = buffers.color
    if color.halves is None:
        return HalvesTest()
    return _core.compare_halves(*color.halves, color.variance, thread_count(threads))
