"""Tungsten itself as the host: renders a scene in this process and hands over its camera's buffers.

The package must have been built against a Tungsten (docs/tungsten.md). Where Tungsten's libraries cannot
be linked into a Python module, `render` goes through the native command (`hosts.native`), which has the hook
linked in.
"""

from __future__ import annotations

import importlib
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tungsten_dip.buffers.render_buffers import CHANNELS, Buffer, RenderBuffers
from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError
from tungsten_dip.hosts.memory import TUNGSTEN_BYTES_PER_PIXEL, pixels_that_fit, too_large
from tungsten_dip.hosts.native import BUILD_HINT, executable, render_in_child
from tungsten_dip.hosts.options import RANGES, checked_option
from tungsten_dip.interrupts import interrupts_as_requests
from tungsten_dip.progress import Progress, silent
from tungsten_dip.scene.types import TonemapName

_LOG = logging.getLogger(__name__)

# Tungsten's messages quote files: where those are no UTF-8, its exception cannot be turned into Python's.
_FAILED = (RuntimeError, UnicodeDecodeError)

_Arrays = Mapping[str, Any]
"""What the hook hands over: {quantity: {mean, half_a, half_b, variance}, "spp": a number or an array}."""


@dataclass(frozen=True)
class DriverOptions:
    """The stock command's flags. None: as the scene file has it; its folder for `input_directory`, all cores
    that this process may run on for `threads`, the stock command's own for `seed`.

    File names and folders are relative to the working directory, `output_file` and `hdr_output_file` to
    `output_directory` where that is given. `restart` ignores a saved state that could be resumed.
    """

    threads: int | None = None
    spp: int | None = None
    seed: int | None = None
    restart: bool = False
    checkpoint_interval_s: float | None = None
    timeout_s: float | None = None
    input_directory: Path | None = None
    output_directory: Path | None = None
    output_file: Path | None = None
    hdr_output_file: Path | None = None

    def __post_init__(self) -> None:
        for name in RANGES:
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, checked_option(name, value))


@dataclass(frozen=True)
class Rendered:
    """A render: finished, ended by Ctrl-C, or at a checkpoint.

    ``output_file`` is the absolute path of the picture that Tungsten writes of it, ``failure`` what
    `drive`'s ``on_checkpoint`` raised.
    """

    buffers: RenderBuffers
    output_file: Path | None
    tonemap: TonemapName
    interrupted: bool = False
    failure: Exception | None = None


def available() -> bool:
    """Return whether this package was built against a Tungsten."""
    return _module() is not None or executable() is not None


def in_process() -> bool:
    """Return whether Tungsten can render in this process; otherwise the native command can do everything."""
    return _module() is not None


def render(
    scene_path: str | Path,
    spp: int | None = None,
    seed: int | None = None,
    threads: int | None = None,
    input_directory: str | Path | None = None,
    progress: Progress = silent,
) -> RenderBuffers:
    """Render a scene and return its buffers; writes no file.

    None takes the scene's ``spp``, the stock command's seed, all cores that this process may run on, and the
    files beside the scene. The sampler is the independent one whatever the scene says: with Tungsten's
    default the halves A and B would not be independent.

    Raises InputError if Tungsten cannot load or render the scene, or is not there.
    """
    folder = None if input_directory is None else Path(input_directory)
    options = DriverOptions(spp=spp, seed=seed, threads=threads, input_directory=folder)
    if _module() is None:
        given = {name: getattr(options, name) for name in ("spp", "seed", "threads", "input_directory")}
        return render_in_child(Path(scene_path), given, progress)
    session = _load(Path(scene_path), options)
    if _render_passes(session, Path(scene_path), options, None, progress):
        raise KeyboardInterrupt
    return _buffers(session.plan, session.take_buffers())


def drive(
    scene_path: str | Path,
    options: DriverOptions | None = None,
    on_checkpoint: Callable[[Rendered], None] | None = None,
    progress: Progress = silent,
) -> Rendered:
    """Render a scene as the stock command does, its files included, and return its buffers.

    As the stock command: checkpoints, a timeout that ends the render at the next pass, resuming. The
    differences: the sampler is independent, every buffer that guides a fit is rendered, and the state
    that can be resumed is kept in a file of its own (``_dip`` added to its name), since other buffers are
    in it. ``on_checkpoint`` is given a copy of what is known at each checkpoint; if it fails, the render
    goes on without it, and its error is the result's ``failure``.

    Whatever happens, the files that Tungsten can write are written before this returns or raises. The first
    Ctrl-C ends the render after the pass in hand or in ``on_checkpoint`` (``interrupted``), a second one
    during a pass ends the process.

    Raises InputError if Tungsten cannot load or render the scene, or is not there.
    """
    options = options or DriverOptions()
    session = _load(Path(scene_path), options)
    plan = session.plan

    def rendered(arrays: _Arrays) -> Rendered:
        output_file = Path(plan.output_file) if plan.output_file else None
        return Rendered(_buffers(plan, arrays), output_file, plan.tonemap)

    failure: Exception | None = None

    def checkpoint() -> None:
        nonlocal failure
        session.save_checkpoint()
        if on_checkpoint is not None and failure is None and not session.done:
            try:
                on_checkpoint(rendered(session.buffers()))
            except Exception as error:
                failure = error
                _LOG.warning("the preview failed, the render goes on without: %s", error)

    try:
        interrupted = _render_passes(session, Path(scene_path), options, checkpoint, progress)
    except KeyboardInterrupt:
        if session.current_spp == 0:
            raise
        interrupted = True
    finally:
        if session.current_spp > 0:
            session.save_outputs()
    return replace(rendered(session.take_buffers()), interrupted=interrupted, failure=failure)


def _load(scene: Path, options: DriverOptions) -> Any:
    module = _require_module()
    if not scene.is_file():
        raise InputError(f"{scene}: expected a scene file, found none; check the path")
    names = ("input_directory", "output_directory", "output_file", "hdr_output_file")
    paths = {name: str(getattr(options, name) or "") for name in names}
    max_pixels = pixels_that_fit(TUNGSTEN_BYTES_PER_PIXEL)
    try:
        return module.Render(
            str(scene),
            threads=thread_count(options.threads),
            max_pixels=max_pixels,
            spp=options.spp,
            seed=options.seed,
            **paths,
        )
    except module.PictureTooLarge as size:
        raise too_large(scene, str(size), max_pixels) from None
    except _FAILED as error:
        raise InputError(
            f"{scene}: Tungsten cannot load it ({error}); check the scene and the files that it names"
        ) from None


def _render_passes(
    session: Any,
    scene: Path,
    options: DriverOptions,
    checkpoint: Callable[[], None] | None,
    progress: Progress,
) -> bool:
    """Render until done or out of time; return whether Ctrl-C ended it early."""
    plan = session.plan
    if not plan.writes_features:
        _LOG.info("%s: the integrator %s writes no feature buffers: colour alone", scene, plan.integrator)
    if checkpoint is not None and plan.resume and not options.restart:
        _resume(session, scene)
    interval_s = options.checkpoint_interval_s
    interval_s = plan.checkpoint_interval_s if interval_s is None else interval_s
    timeout_s = plan.timeout_s if options.timeout_s is None else options.timeout_s

    start = last_checkpoint = time.monotonic()
    total = max(session.total_spp, 1)
    while not session.done:
        progress(session.current_spp / total, f"{session.current_spp}/{total} spp")
        with interrupts_as_requests(
            "stopping after this pass; Ctrl-C again stops at once and saves nothing"
        ) as interrupt_requested:
            try:
                session.render_pass()
            except _FAILED as error:
                raise InputError(f"{scene}: Tungsten cannot render it: {error}") from None
        if interrupt_requested():
            return True
        now = time.monotonic()
        if timeout_s > 0 and now - start > timeout_s:
            _LOG.info("%s: out of time after %d of %d spp", scene, session.current_spp, total)
            break
        if checkpoint is not None and interval_s > 0 and now - last_checkpoint > interval_s:
            checkpoint()
            last_checkpoint = time.monotonic()
    progress(1.0, f"{session.current_spp}/{total} spp")
    return False


def _resume(session: Any, scene: Path) -> None:
    try:
        resumed = session.resume()
    except _FAILED as error:
        message = f"{scene}: its saved state cannot be read: {error}; delete it, or render with --restart"
        raise InputError(" ".join(message.split())) from None
    if resumed:
        _LOG.info("resuming at %d spp", session.current_spp)
    else:
        _LOG.info("no saved state of this scene with all buffers: starting at 0 spp")


def _buffers(plan: Any, arrays: _Arrays) -> RenderBuffers:
    spp = arrays["spp"]
    planes = {name: dict(arrays[name]) for name in CHANNELS if name in arrays}
    if np.max(spp) < 2 and plan.writes_features:
        # The second half is empty and the variance is zero: neither says anything.
        _LOG.warning("1 sample per pixel has no halves and no variance; render at least 2")
        planes = {name: {"mean": known["mean"]} for name, known in planes.items()}
    attributes = {
        "renderer": f"Tungsten {_require_module().tungsten_version}",
        "integrator": plan.integrator,
        "seed": str(plan.seed),  # an EXR's whole numbers end at 2^31
    }
    buffers: dict[str, Any] = {name: Buffer(**known) for name, known in planes.items()}
    return RenderBuffers(**buffers, spp=spp, attributes=attributes)


@cache
def _module() -> Any | None:
    """The hook: linked into the native command, or importable, or neither. A failure is told once."""
    try:
        return importlib.import_module("tungsten_dip._tungsten")
    except ModuleNotFoundError:
        return None
    except ImportError as error:
        _LOG.warning("the hook for Tungsten cannot be loaded: %s", error)
        return None


def _require_module() -> Any:
    module = _module()
    if module is None:
        raise InputError(f"Tungsten cannot render in this process; {BUILD_HINT}")
    return module
