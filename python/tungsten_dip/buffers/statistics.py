"""What the halves of a render and its sample variance tell of its noise."""

from __future__ import annotations

from tungsten_dip import _core
from tungsten_dip._core import HalvesTest
from tungsten_dip.buffers.model import Buffer, FloatImage, RenderBuffers

__all__ = ["HalvesTest", "halves_independent", "variance_of_mean"]


def halves_independent(buffers: RenderBuffers, threads: int | None = None) -> HalvesTest:
    """Test whether the noise of the colour's halves is independent, as scoring one by the other assumes.

    Halves of a low-discrepancy sampler mirror each other (Tungsten's Sobol sampler: correlation -0.2), and
    halves may be copies of one image. The correlation is taken of what a second-order difference leaves of
    both halves; where texture makes it positive, the sample variance decides, if it is known. Without
    halves, and where nothing in the image tells, ``independent`` is False. Expects sanitised buffers.
    """
    color = buffers.color
    if color.half_a is None or color.half_b is None:
        return HalvesTest()
    return _core.compare_halves(color.half_a, color.half_b, color.variance, threads or 0)


def variance_of_mean(buffer: Buffer, threads: int | None = None) -> FloatImage | None:
    """Estimate the variance of ``buffer.mean`` (same shape); None if neither halves nor variance are known.

    With both, the sample variance is scaled to agree locally with the halves (Rousselle et al. 2012,
    "Adaptive Rendering with Non-Local Means Filtering"); halves alone give an unbiased but very noisy
    estimate.
    """
    if buffer.half_a is None or buffer.half_b is None:
        return buffer.variance
    if buffer.variance is None:
        return _core.halves_variance(buffer.half_a, buffer.half_b, threads or 0)
    return _core.calibrate_variance(buffer.variance, buffer.half_a, buffer.half_b, threads or 0)
