"""Uses the network of another image as it is: the presets draft, balanced and final without training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tungsten_dip.buffers.render_buffers import FloatImage, Halves, RenderBuffers
from tungsten_dip.cores import thread_count
from tungsten_dip.fit.blending import blended_images, result_from_image
from tungsten_dip.fit.candidates import Candidates
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.evidence import Cues, evidence_from_buffers
from tungsten_dip.fit.model import Blend, Model
from tungsten_dip.fit.network.blend_network import BlendNetwork
from tungsten_dip.fit.network.inputs import INPUTS_RADIUS, network_inputs
from tungsten_dip.fit.output.all_samples import pilots_of_all_samples
from tungsten_dip.fit.output.denoised import denoised_image, image_without_noise
from tungsten_dip.fit.preparation.splitting import with_independent_halves
from tungsten_dip.fit.presets import recipe_of
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.progress import Progress

_BAND_PIXELS = 1 << 18
"""Pixels whose inputs are computed at a time."""


def infer_blend(
    model: Model,
    buffers: RenderBuffers,
    settings: FitSettings,
    progress: Progress,
    previous: Halves | None = None,
) -> FitResult:
    """Denoise sanitised buffers with the network of ``model``, which blends, on the device of the settings.

    ``previous`` is as in `tungsten_dip.fit.blending.fit_blend`.
    """
    clock, threads = Clock(), thread_count(settings.threads)
    assert model.blend is not None
    unchanged = image_without_noise(buffers, threads)
    if unchanged is not None:
        progress(1.0, "no noise")
        return result_from_image(unchanged, settings, clock)
    halved = with_independent_halves(buffers, settings.seed, threads)
    layout = model.blend.layout
    with_oidn = settings.pilot == "oidn"
    evidence, cues = evidence_from_buffers(
        halved, layout, clock, progress, threads=threads, with_oidn=with_oidn, previous=previous
    )
    all_samples_pilots: tuple[FloatImage, ...] = ()
    if recipe_of(settings, following=previous is not None).all_samples:
        all_samples_pilots = pilots_of_all_samples(evidence, halved.buffers, clock, with_oidn=with_oidn)
    network = BlendNetwork(layout, model.weights, settings.device, threads)
    blended = _blended(network, model.blend, evidence.candidates, cues, all_samples_pilots, threads)
    image = denoised_image(evidence, *blended)
    progress(1.0, "inferred")
    return result_from_image(image, settings, clock, evidence.halves_drawn, model)


def _blended(
    network: BlendNetwork,
    blend: Blend,
    candidates: Candidates,
    cues: Cues,
    all_samples_pilots: Sequence[FloatImage],
    threads: int,
) -> tuple[Halves, FloatImage | None]:
    """Return what `blended_images` does, band by band: the inputs of a large image need gigabytes."""
    height, width = candidates.noisy[0].shape[:2]
    rows = max(1, _BAND_PIXELS // width)
    bands = []
    for first in range(0, height, rows):
        end = min(first + rows, height)
        # The inputs of a row come from the rows around it.
        above, below = max(first - INPUTS_RADIUS, 0), min(end + INPUTS_RADIUS, height)
        around = candidates.rows(above, below)
        inputs = network_inputs(blend.layout, around, cues.rows(above, below), threads)
        inputs = inputs[:, (first - above) * width : (end - above) * width]
        blend.standardisation.apply(inputs, threads)
        pilots = [pilot[first:end] for pilot in all_samples_pilots]
        bands.append(blended_images(network, inputs, candidates.rows(first, end), pilots, threads))
    halves, blends = zip(*bands, strict=True)
    a, b = (np.concatenate(images) for images in zip(*halves, strict=True))
    return (a, b), np.concatenate(blends) if all_samples_pilots else None
