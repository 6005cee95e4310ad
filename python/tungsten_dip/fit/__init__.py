"""Fits: from noisy buffers to a clean image. Only `paper` imports torch."""

from __future__ import annotations

from dataclasses import replace

from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.errors import check_type
from tungsten_dip.extras import require
from tungsten_dip.fit.model import Model, check_settings
from tungsten_dip.fit.preparation.prepare import finish_result, prepare_input
from tungsten_dip.fit.result import FitResult
from tungsten_dip.fit.settings import FitSettings
from tungsten_dip.interrupts import deferred_interrupts
from tungsten_dip.progress import Progress, silent

__all__ = ["FitResult", "FitSettings", "check_ready", "denoise"]


def check_ready(settings: FitSettings, warm_start: Model | None = None) -> None:
    """Raise InputError if a package or device is missing, or the settings are not ``warm_start``'s.

    Loads neither Open Image Denoise nor, but for a GPU, torch: a render may come before the fit.
    """
    if settings.preset == "paper":
        require("torch", "preset paper")
        if settings.device == "cuda":
            with deferred_interrupts():
                from tungsten_dip.fit.paper.device import check_torch_device

            check_torch_device(settings.device)
    else:
        with deferred_interrupts():
            from tungsten_dip.graphs.sessions import check_device

        check_device(settings.device)
        if settings.pilot == "oidn":
            require("pyoidn", "Open Image Denoise")
    if warm_start is not None:
        check_settings(warm_start, settings)


def denoise(
    buffers: RenderBuffers,
    settings: FitSettings | None = None,
    progress: Progress = silent,
    *,
    warm_start: Model | None = None,
) -> FitResult:
    """Denoise one image, fitting a network to it and to nothing else.

    ``buffers`` hold linear radiance of any exposure; they are sanitised first, and only the colour is
    required. The result is linear radiance of the same shape, finite everywhere. The same buffers, settings,
    threads and machine give the same bits, but for a time budget. Ctrl-C once the network is in training ends
    the fit early with the image reached so far.

    With ``warm_start`` (of an earlier frame, for example) the network starts from the model's weights, with
    its pilots and constants, and trains until the error estimated from the halves falls no further, for at
    most ``settings.iterations`` steps (all of them with ``paper``). Without settings, those that determine
    the model's network hold (`Model.settings`), but for the iterations.

    Raises InputError if an argument is of another type, the image is empty, what the settings require is
    missing (a buffer, a device, torch for the preset paper), or the model does not fit the image or the
    settings.
    """
    if warm_start is not None:
        check_type("warm_start", warm_start, Model, "load_model reads one from a file")
    if settings is None:
        settings = FitSettings() if warm_start is None else replace(warm_start.settings, iterations=None)
    check_type("settings", settings, FitSettings, "use FitSettings(preset=...)")
    check_ready(settings, warm_start)
    prepared = prepare_input(buffers, settings.threads)
    if settings.preset == "paper":
        with deferred_interrupts():
            from tungsten_dip.fit.paper.fit import fit_paper

        result = fit_paper(prepared.buffers, settings, progress, warm_start)
    else:
        with deferred_interrupts():
            from tungsten_dip.fit.blending import fit_blend

        result = fit_blend(prepared.buffers, settings, progress, warm_start)
    return finish_result(result, prepared)
