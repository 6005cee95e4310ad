"""The command ``tungsten``: the stock command's options, a host to render with, and ``--dip-denoise``."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NoReturn, TypeVar

from tungsten_dip.buffers.atomic import check_writable, write_text
from tungsten_dip.buffers.image_file import write_image
from tungsten_dip.buffers.render_buffers import CHANNELS, RenderBuffers
from tungsten_dip.cli.console import line_and_status, minutes, progress_on_stderr, run
from tungsten_dip.cli.denoising import (
    FIT_OPTIONS,
    check_outputs_are_not_inputs,
    denoise_with_progress,
    fit_settings,
    load_warm_start,
    write_model,
)
from tungsten_dip.cli.scene_outputs import SceneOutputs, scene_outputs, write_render
from tungsten_dip.cli.tungsten_options import (
    Options,
    check_checkpoints,
    check_options,
    parse,
    print_help,
    stock_arguments,
)
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitResult, FitSettings, check_ready
from tungsten_dip.fit.model import Model
from tungsten_dip.fit.write import write_denoised
from tungsten_dip.hosts import chosen_host, native
from tungsten_dip.hosts import tungsten as tungsten_host
from tungsten_dip.hosts.mitsuba.render import render as render_with_mitsuba
from tungsten_dip.interrupts import deferred_interrupts
from tungsten_dip.progress import Progress
from tungsten_dip.remarks import remarks_from_log
from tungsten_dip.report.page import report_page
from tungsten_dip.report.preview import side_by_side
from tungsten_dip.scene.effects import decision_of
from tungsten_dip.scene.parse import load_scene
from tungsten_dip.scene.tonemap import display_from_radiance
from tungsten_dip.scene.types import Camera, PerspectiveCamera, Scene, TonemapName

_LOG = logging.getLogger(__name__)

_PREVIEW_INTERVAL_S = 60.0
"""Between checkpoints, where there is to be a preview at each and neither options nor scene name a time."""

Denoise = Callable[[Camera, RenderBuffers], FitResult]
"""Denoises the render of a camera."""

_T = TypeVar("_T")
_R = TypeVar("_R")


@dataclass(frozen=True)
class _Job:
    """A scene to render, its files, and the options with the scene's own seed."""

    scene: Scene
    outputs: SceneOutputs
    options: Options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0 only if every output asked for was written."""
    return run("tungsten", lambda: _run(arguments))


def write_outputs(
    result: FitResult,
    buffers: RenderBuffers,
    outputs: SceneOutputs,
    tonemap: TonemapName,
    report: Path | None,
    remarks: Sequence[str],
    save_model: Path | None,
) -> None:
    """Write a denoised render beside its own files.

    These are ``<stem>_denoised.exr``, ``<stem>_denoised.png``, ``<stem>_side_by_side.png`` and, where asked
    for, the report and the fitted network. ``remarks`` are what was logged of the render and the fit.
    """
    exr, png, pair = outputs.denoised()
    noisy, denoised = (display_from_radiance(color, tonemap) for color in (buffers.color.mean, result.color))
    write_denoised(exr, result, buffers)
    write_image(png, denoised)
    write_image(pair, side_by_side(noisy, denoised))
    if report is not None:
        title = exr.stem.removesuffix("_denoised")
        write_text(report, report_page(title, buffers, result, remarks, tonemap))
    for written in filter(None, (exr, png, pair, report)):
        _LOG.info("wrote %s", written)
    if save_model is not None:
        write_model(save_model, result)
        _LOG.info("wrote %s", save_model)
    if result.interrupted:
        raise KeyboardInterrupt  # what was reached is written; the exit status says that it is not all


def _run(arguments: Sequence[str] | None) -> None:
    options, native_arguments = parse(sys.argv[1:] if arguments is None else arguments)
    if not options.scenes:
        print_help()
        return
    check_options(options)
    host = chosen_host(options.host)
    _LOG.info("rendering with %s", host.capitalize())
    check_checkpoints(options, host)
    if host == "tungsten" and not options.dip_denoise:
        _run_native(stock_arguments(native_arguments))
    if host == "tungsten" and not tungsten_host.in_process():
        _run_native(native_arguments)
    _render_scenes(options, host)


def _render_scenes(options: Options, host: str) -> None:
    """Render every scene in this process, and denoise it if that is asked for.

    Raises InputError in the end if any of several scenes failed.
    """
    warm_start = load_warm_start(options.warm_start)
    settings = fit_settings(vars(options), (*FIT_OPTIONS, "threads"), warm_start)
    count = len(options.scenes)
    denoise, seeds = None, [options.seed] * count
    if options.dip_denoise:
        check_ready(settings, warm_start)
        if count > 1 and settings.preset != "paper":
            denoise = _frame_after_frame(settings, warm_start)
            # The same noise in every frame would not average out.
            first = options.seed or 0
            seeds = [options.seed, *((first + index) % 2**32 for index in range(1, count))]
        else:
            denoise = _each_alone(settings, warm_start)

    def load(path_and_seed: tuple[Path, int | None]) -> tuple[Scene, Options]:
        path, seed = path_and_seed
        return load_scene(path, options.input_directory), replace(options, seed=seed)

    # All of them first: most of what is wrong with the last one is told before hours of rendering.
    loaded = _succeeded(load, zip(options.scenes, seeds, strict=True), count == 1)
    inputs = {file.resolve() for scene, _ in loaded for file in scene.files}
    taken: set[Path] = set()

    def check(scene_and_options: tuple[Scene, Options]) -> _Job:
        scene, its_options = scene_and_options
        return _Job(scene, _checked_outputs(scene, options, taken, inputs), its_options)

    jobs = _succeeded(check, loaded, count == 1)
    done = _succeeded(lambda job: _render_scene(job, host, settings, denoise), jobs, count == 1)
    if len(done) < count:
        raise InputError(f"{count - len(done)} of {count} scenes failed, see above")


def _succeeded(action: Callable[[_T], _R], items: Iterable[_T], alone: bool) -> list[_R]:
    """Return what becomes of the items but for those that fail, which is logged.

    Raises what is wrong instead if the item is ``alone``.
    """
    results = []
    for item in items:
        try:
            results.append(action(item))
        except Exception as error:
            if alone or isinstance(error, BrokenPipeError):
                raise
            _LOG.debug("failed", exc_info=error)
            _LOG.error("%s", line_and_status(error)[0])
    return results


def _run_native(arguments: Sequence[str]) -> NoReturn:
    """Replace this process by the native command; without ``--dip-`` flags that is stock Tungsten.

    Raises InputError if the package was built without a Tungsten.
    """
    command = native.required_executable()
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(command, ["tungsten", *arguments], native.environment())


def _render_scene(job: _Job, host: str, settings: FitSettings, denoise: Denoise | None) -> None:
    """Render one scene, write its files, then denoise: an interrupted fit leaves the render's files.

    Raises InputError as whatever is called here does.
    """
    scene, outputs, options = job.scene, job.outputs, job.options
    with remarks_from_log() as remarks:
        with progress_on_stderr(f"rendering {scene.path.name}") as progress:
            if host == "tungsten":
                buffers, unwritten = _render_with_tungsten(scene, outputs, options, settings, progress)
            else:
                buffers, unwritten = _render_with_mitsuba(scene, options, progress), outputs
        write_render(buffers, unwritten, scene.camera.tonemap)
        for picture in filter(None, (outputs.ldr, outputs.hdr)):
            _LOG.info("wrote %s", picture)
        if denoise is not None:
            result = denoise(scene.camera, buffers)
            tonemap = scene.camera.tonemap
            write_outputs(result, buffers, outputs, tonemap, options.report, remarks, options.save_model)


def _checked_outputs(scene: Scene, options: Options, taken: set[Path], inputs: set[Path]) -> SceneOutputs:
    """Return what a scene writes.

    ``taken`` are the files of the scenes before, to which this one's are added, with what is made of the
    render; ``inputs`` are what all scenes read.

    Raises InputError if a file cannot be written, or would be written over an input or one that is taken.
    """
    if options.output_directory is not None:
        try:
            options.output_directory.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise InputError(
                f"{options.output_directory}: expected a folder, found a file; choose another name"
            ) from error
    outputs = scene_outputs(
        scene,
        options.output_directory,
        options.output_file,
        options.hdr_output_file,
    )
    if options.dip_denoise:
        outputs = outputs.with_both_pictures()
    outputs.check()
    if not scene.renderer.overwrite_output_files:
        outputs = outputs.numbered(options.dip_denoise, taken)
        outputs.check()
    own = list(outputs.denoised()) if options.dip_denoise else []
    if options.dip_preview:
        own.append(outputs.preview())
    for file in own:
        check_writable(file, file.suffix)
    rendered, derived = {file.resolve() for file, _ in outputs.files()}, {file.resolve() for file in own}
    check_outputs_are_not_inputs(sorted(rendered | derived), inputs, folders=(), mapping={})
    both = rendered & derived
    if both:
        raise InputError(f"{min(both)}: named for the render and for what is made of it; name two files")
    overwritten = taken & (rendered | derived)
    if overwritten:
        raise InputError(
            f"{scene.path}: would write over {min(overwritten)}, which belongs to a scene before; give every "
            "scene file names of its own"
        )
    if options.report is not None:
        check_writable(options.report, ".html")
    if options.save_model is not None:
        check_writable(options.save_model, ".onnx")
    taken |= rendered | derived
    return outputs


def _render_with_tungsten(
    scene: Scene,
    outputs: SceneOutputs,
    options: Options,
    settings: FitSettings,
    progress: Progress,
) -> tuple[RenderBuffers, SceneOutputs]:
    """Render a scene; return its buffers, and what Tungsten has not written of its outputs.

    Raises KeyboardInterrupt if Ctrl-C ended the render, and what a preview raised, with all outputs written.
    """
    preview = _preview(outputs, settings) if options.dip_preview else None
    before = {path: _last_written(path) for path, _ in outputs.files()}
    rendered = tungsten_host.drive(scene.path, _driver_options(options, scene, outputs), preview, progress)

    # A Tungsten that was built without OpenEXR writes no .exr, and says nothing of it.
    def is_unwritten(path: Path) -> bool:
        return _last_written(path) == before[path]

    unwritten = SceneOutputs(
        ldr=None if rendered.output_file else outputs.ldr,
        hdr=outputs.hdr if outputs.hdr and is_unwritten(outputs.hdr) else None,
        buffers=tuple(
            replace(buffer, ldr_output_file="")
            for buffer in outputs.buffers
            if buffer.hdr_output_file and is_unwritten(Path(buffer.hdr_output_file))
        ),
    )
    stop = KeyboardInterrupt() if rendered.interrupted else rendered.failure
    if stop is not None:
        write_render(rendered.buffers, unwritten, rendered.tonemap)
        raise stop
    return rendered.buffers, unwritten


def _last_written(path: Path) -> int | None:
    """Return the time of a file's last change in nanoseconds, None where there is no file."""
    return path.stat().st_mtime_ns if path.exists() else None


def _each_alone(settings: FitSettings, warm_start: Model | None) -> Denoise:
    return lambda _, buffers: denoise_with_progress(buffers, settings, warm_start)


def _frame_after_frame(settings: FitSettings, warm_start: Model | None) -> Denoise:
    """Return what denoises scenes as frames, each starting from the one before."""
    with deferred_interrupts():
        from tungsten_dip.sequence.following import Follower, Models

    follower = Follower(settings, models=Models(alone=warm_start))

    def denoise(camera: Camera, buffers: RenderBuffers) -> FitResult:
        known = camera if isinstance(camera, PerspectiveCamera) else None
        if known is None:
            _LOG.info("a camera of type %s moves no frame into place", camera.kind)
        with progress_on_stderr("denoising") as progress:
            return follower.denoise(buffers, known, progress).result

    return denoise


def _preview(outputs: SceneOutputs, settings: FitSettings) -> Callable[[tungsten_host.Rendered], None]:
    """Return what writes a quickly denoised picture of a render that goes on."""
    path = outputs.preview()
    draft = FitSettings(preset="draft", device=settings.device, threads=settings.threads)

    def write(rendered: tungsten_host.Rendered) -> None:
        result = denoise_with_progress(rendered.buffers, draft)
        write_image(path, display_from_radiance(result.color, rendered.tonemap))
        _LOG.info("wrote %s", path)
        if result.interrupted:
            raise KeyboardInterrupt  # which was meant for the render

    return write


def _driver_options(options: Options, scene: Scene, outputs: SceneOutputs) -> tungsten_host.DriverOptions:
    asked_ldr = options.output_file or scene.renderer.output_file
    asked_hdr = options.hdr_output_file or scene.renderer.hdr_output_file
    return tungsten_host.DriverOptions(
        threads=options.threads,
        spp=options.spp,
        seed=options.seed,
        restart=options.restart,
        checkpoint_interval_s=_checkpoint_interval(scene, options),
        timeout_s=options.timeout,
        input_directory=options.input_directory,
        output_directory=options.output_directory,
        # The names that were checked: Tungsten would place or number some differently.
        output_file=outputs.ldr.absolute() if asked_ldr and outputs.ldr else None,
        hdr_output_file=outputs.hdr.absolute() if asked_hdr and outputs.hdr else None,
    )


def _checkpoint_interval(scene: Scene, options: Options) -> float | None:
    """Return the seconds between checkpoints, None as the scene has it."""
    if options.dip_preview and options.checkpoint is None and not _seconds(scene, "checkpoint_interval"):
        return _PREVIEW_INTERVAL_S
    return options.checkpoint


def _render_with_mitsuba(scene: Scene, options: Options, progress: Progress) -> RenderBuffers:
    if scene.renderer.enable_resume_render:
        _LOG.warning("%s: asks to resume; Mitsuba saves no state and starts from 0 spp", scene.path)
    wanted = {"color", *(request.type for request in scene.renderer.output_buffers)}
    if options.dip_denoise:
        wanted |= set(decision_of(scene).buffers)
    return render_with_mitsuba(
        scene,
        spp=options.spp,
        seed=options.seed or 0,
        threads=options.threads,
        timeout_s=(_seconds(scene, "timeout") if options.timeout is None else options.timeout) or None,
        progress=progress,
        quantities=[name for name in CHANNELS if name in wanted],
    )


def _seconds(scene: Scene, setting: Literal["checkpoint_interval", "timeout"]) -> float:
    try:
        return minutes(getattr(scene.renderer, setting))
    except argparse.ArgumentTypeError as error:
        raise InputError(f"{scene.path}: renderer.{setting}: {error}; correct it") from None
