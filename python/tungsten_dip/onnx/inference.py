"""Denoise with a fitted network."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tungsten_dip.buffers.display import radiance_from_ldr
from tungsten_dip.buffers.render_buffers import FloatImage, RenderBuffers
from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError, check_type, whole_number
from tungsten_dip.fit import check_ready
from tungsten_dip.fit.blending import fit_blend
from tungsten_dip.fit.clock import Clock
from tungsten_dip.fit.inference import infer_blend
from tungsten_dip.fit.model import Model, check_finite, check_inputs
from tungsten_dip.fit.paper.images import network_input, paper_images
from tungsten_dip.fit.preparation.prepare import finish_result, prepare_input
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import MOST_ITERATIONS, FitSettings
from tungsten_dip.graphs.sessions import session_from_proto
from tungsten_dip.onnx.graph import graph_of
from tungsten_dip.progress import Progress, silent


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
    settings = checked_settings(model, threads, refit_steps)
    prepared = prepare_input(buffers, threads)
    if model.is_paper:
        result = _infer_paper(model, prepared.buffers, settings, progress)
    elif refit_steps:
        result = fit_blend(prepared.buffers, settings, progress, model, refit_steps=refit_steps)
    else:
        result = infer_blend(model, prepared.buffers, settings, progress)
    return finish_result(result, prepared)


def checked_settings(model: Model, threads: int | None, refit_steps: int) -> FitSettings:
    """Return the settings that a model is used with, for the arguments of `infer`.

    Raises InputError if these cannot be done, or a package is missing.
    """
    whole_number("refit_steps", refit_steps, 0, MOST_ITERATIONS)
    settings = replace(model.settings, threads=threads, iterations=None)
    if not model.is_paper:
        check_ready(settings)
    elif refit_steps:
        raise InputError(
            f"refit: expected 0 steps of a network of preset paper, got {refit_steps}; fit from it instead"
        )
    return settings


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
