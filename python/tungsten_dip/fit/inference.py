"""Uses the network of another image as it is: the presets draft, balanced and final without training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tungsten_dip.buffers.render_buffers import FloatImage, Halves, RenderBuffers
from tungsten_dip.fit.blending import blended_images, blends_all_samples
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.evidence import Evidence, evidence_from_buffers
from tungsten_dip.fit.model import Model
from tungsten_dip.fit.network.blend_network import BlendNetwork
from tungsten_dip.fit.network.inputs import INPUTS_RADIUS, network_inputs
from tungsten_dip.fit.network.standardisation import Standardisation
from tungsten_dip.fit.output.all_samples import pilots_of_all_samples
from tungsten_dip.fit.output.denoised import denoised_image, result_without_noise
from tungsten_dip.fit.preparation.splitting import with_independent_halves
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
    clock = Clock()
    assert model.blend is not None
    unchanged = result_without_noise(buffers, settings, clock, progress)
    if unchanged is not None:
        return unchanged
    halved = with_independent_halves(buffers, settings.seed, settings.threads)
    evidence = evidence_from_buffers(halved, settings, model.blend.layout, clock, progress, previous)
    all_samples_pilots: tuple[FloatImage, ...] = ()
    if blends_all_samples(settings, following=previous is not None):
        all_samples_pilots = pilots_of_all_samples(evidence, halved.buffers, settings, clock)
    layout = evidence.layout
    network = BlendNetwork(
        model.weights, len(layout.inputs), layout.candidate_count, settings.device, evidence.threads
    )
    denoised, all_samples_blend = _blended(network, model.blend.standardisation, evidence, all_samples_pilots)
    result = denoised_image(evidence, denoised, all_samples_blend, settings, clock)
    progress(1.0, "inferred")
    return replace(result, model=model)


def _blended(
    network: BlendNetwork,
    standardisation: Standardisation,
    evidence: Evidence,
    all_samples_pilots: Sequence[FloatImage],
) -> tuple[Halves, FloatImage | None]:
    """Return what `blended_images` does, band by band: the inputs of a large image need gigabytes."""
    height, width = evidence.mean.shape[:2]
    rows = max(1, _BAND_PIXELS // width)
    bands = []
    for first in range(0, height, rows):
        end = min(first + rows, height)
        # The inputs of a row come from the rows around it.
        above, below = max(first - INPUTS_RADIUS, 0), min(end + INPUTS_RADIUS, height)
        inputs = network_inputs(evidence.rows(above, below))[
            :, (first - above) * width : (end - above) * width
        ]
        standardisation.apply(inputs, evidence.threads)
        pilots = [pilot[first:end] for pilot in all_samples_pilots]
        bands.append(blended_images(network, inputs, evidence.rows(first, end), pilots))
    halves, blends = zip(*bands, strict=True)
    a, b = (np.concatenate(images) for images in zip(*halves, strict=True))
    return (a, b), np.concatenate(blends) if all_samples_pilots else None
