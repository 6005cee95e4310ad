"""Denoise with a fitted network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tungsten_dip.buffers.display import radiance_from_ldr
from tungsten_dip.buffers.render_buffers import FloatImage, Halves, RenderBuffers
from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError, check_type, whole_number
from tungsten_dip.fit import check_ready
from tungsten_dip.fit.blend_network import BlendNetwork
from tungsten_dip.fit.blending import blended_images, blends_all_samples, fit_blend
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.denoised import denoised_image, result_without_noise
from tungsten_dip.fit.evidence import Evidence, evidence_from_buffers, pilots_of_all_samples
from tungsten_dip.fit.inputs import INPUTS_RADIUS, network_inputs
from tungsten_dip.fit.model import Model, check_finite, check_inputs
from tungsten_dip.fit.paper.images import network_input, paper_images
from tungsten_dip.fit.preparation import finish_result, prepare_input
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import MOST_ITERATIONS, FitSettings
from tungsten_dip.fit.splitting import with_independent_halves
from tungsten_dip.graphs.sessions import Device, session_from_proto
from tungsten_dip.onnx.graph import graph_of
from tungsten_dip.progress import Progress, silent

_BAND_PIXELS = 1 << 18


def infer(
    model: Model,
    buffers: RenderBuffers,
    progress: Progress = silent,
    *,
    threads: int | None = None,
    refit_steps: int = 0,
) -> FitResult:
    """Denoise one image with a fitted network, by onnxruntime alone.

    ``buffers`` are as in `tungsten_dip.denoise`, with the features of the fit. ``threads`` None uses every
    core. With ``refit_steps``, a blend network is first trained further on this image, as by a warm
    start, for so many steps at most; the result's ``model`` is then the refined one. An image too unlike the
    model's gets a new network instead, with all the steps of a fit. A network of the preset paper outputs the
    image itself, and its error is not estimated.

    Raises InputError if the image is empty, the model does not fit it or gives no finite image for it, or
    refit_steps cannot be done.
    """
    check_type("model", model, Model, "load_model reads one from a file")
    settings = inference_settings(model, threads, refit_steps)
    prepared = prepare_input(buffers, threads)
    if model.layout is None:
        result = _infer_paper(model, prepared.buffers, settings, progress)
    elif refit_steps:
        result = fit_blend(prepared.buffers, settings, progress, model, refit_steps=refit_steps)
    else:
        result = infer_blend(model, prepared.buffers, settings, progress)
    return finish_result(result, prepared)


def inference_settings(model: Model, threads: int | None, refit_steps: int) -> FitSettings:
    """Return the settings that a model is used with, for the arguments of `infer`.

    Raises InputError if these cannot be done, or a package is missing.
    """
    whole_number("refit_steps", refit_steps, 0, MOST_ITERATIONS)
    settings = replace(model.settings, threads=threads, iterations=None)
    if model.layout is not None:
        check_ready(settings)
    elif refit_steps:
        raise InputError(
            f"refit: expected 0 steps of a network of preset paper, got {refit_steps}; fit from it instead"
        )
    return settings


def infer_blend(
    model: Model,
    buffers: RenderBuffers,
    settings: FitSettings,
    progress: Progress,
    previous: Halves | None = None,
) -> FitResult:
    """Denoise sanitised buffers with a blend network, on the device of the settings; see `infer`.

    ``previous`` is as in `tungsten_dip.fit.blending.fit_blend`.
    """
    clock = Clock()
    assert model.layout is not None
    unchanged = result_without_noise(buffers, settings, clock, progress)
    if unchanged is not None:
        return unchanged
    halved = with_independent_halves(buffers, settings.seed, settings.threads)
    evidence = evidence_from_buffers(halved, settings, model.layout, clock, progress, previous)
    all_samples_pilots: tuple[FloatImage, ...] = ()
    if blends_all_samples(settings, following=previous is not None):
        all_samples_pilots = pilots_of_all_samples(evidence, halved.buffers, settings, clock)
    denoised, all_samples_blend = _blended(model, evidence, all_samples_pilots, settings.device)
    result = denoised_image(evidence, denoised, all_samples_blend, settings, clock)
    progress(1.0, "inferred")
    return replace(result, model=model)


def _blended(
    model: Model, evidence: Evidence, all_samples_pilots: Sequence[FloatImage], device: Device
) -> tuple[Halves, FloatImage | None]:
    """Return what `blended_images` does, band by band: the inputs of a large image need gigabytes."""
    assert model.standardisation is not None
    layout, threads = evidence.layout, evidence.threads
    network = BlendNetwork(model.weights, len(layout.inputs), layout.candidate_count, device, threads)
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
        model.standardisation.apply(inputs, threads)
        pilots = [pilot[first:end] for pilot in all_samples_pilots]
        bands.append(blended_images(network, inputs, evidence.rows(first, end), pilots))
    halves, blends = zip(*bands, strict=True)
    a, b = (np.concatenate(images) for images in zip(*halves, strict=True))
    return (a, b), np.concatenate(blends) if all_samples_pilots else None


def _infer_paper(
    model: Model, buffers: RenderBuffers, settings: FitSettings, progress: Progress
) -> FitResult:
    clock = Clock()
    images = paper_images(buffers, settings)
    check_inputs(model, images.inputs)
    inputs = network_input(images, settings.seed).transpose(2, 0, 1)[None]
    # Norms of the whole image: no bands here.
    session = session_from_proto(graph_of(model), thread_count(settings.threads), settings.device)
    output = session.run(["color"], {"inputs": np.ascontiguousarray(inputs)})[0]
    check_finite(output)
    ldr = output[0, :3].transpose(1, 2, 0)
    color: FloatImage = np.ascontiguousarray(radiance_from_ldr(ldr))
    progress(1.0, "inferred")
    return FitResult(color, settings, clock.seconds(), iterations=0, model=model, notes=images.notes)
