"""The published method over its iterations: one fit, sampled after several of them."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import dataclass

from tungsten_dip.buffers.render_buffers import FloatImage, RenderBuffers
from tungsten_dip.fit.paper.images import paper_images
from tungsten_dip.fit.preparation.prepare import prepare_input
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.progress import Progress


@dataclass(frozen=True)
class PaperPoint:
    """The state of the fit after an iteration.

    ``seconds`` are those of the fit, without the time of sampling it. ``loss`` and ``psnr_noisy`` (dB, of the
    displayed images) are of the iteration's own output, as published; ``color`` is the running average that
    the method gives as its result, linear radiance of shape (height, width, 3).
    """

    iteration: int
    seconds: float
    loss: float
    psnr_noisy: float
    color: FloatImage


def paper_curve(
    buffers: RenderBuffers, settings: FitSettings, checkpoints: Collection[int], progress: Progress
) -> list[PaperPoint]:
    """Fit up to the largest of the checkpoints, and return what was reached at each.

    Raises InputError as `fit.paper.fit.fit_paper` does.
    """
    from tungsten_dip.fit.paper.device import compute_device
    from tungsten_dip.fit.paper.fit import PaperFit

    start = time.perf_counter()
    sampling_s = 0.0
    points = []
    total = max(checkpoints)
    buffers = prepare_input(buffers, settings.threads).buffers
    with compute_device(settings) as device:
        fit = PaperFit(paper_images(buffers, settings), settings, device)
        for iteration in range(1, total + 1):
            fit.step()
            progress(iteration / total, f"iteration {iteration}, PSNR to noisy {fit.psnr:.2f} dB")
            if iteration in checkpoints:
                paused = time.perf_counter()
                color = fit.color()
                seconds = paused - start - sampling_s
                points.append(PaperPoint(iteration, seconds, fit.loss, fit.psnr, color))
                sampling_s += time.perf_counter() - paused
    return points


def checkpoints_up_to(iterations: int, first: int = 100) -> tuple[int, ...]:
    """Return 1 and 3 times the powers of ten from ``first`` on, and ``iterations``."""
    rounded = (digit * 10**exponent for exponent in range(len(str(iterations))) for digit in (1, 3))
    return (*(count for count in rounded if first <= count < iterations), iterations)
