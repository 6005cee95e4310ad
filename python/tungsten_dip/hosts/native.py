"""The native command ``tungsten`` that was built with this package, in a process of its own.

Where Python cannot load Tungsten, it also renders for `hosts.tungsten`, and leaves the buffers in a folder.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from tungsten_dip.buffers.render_buffers import CHANNELS, Buffer, RenderBuffers
from tungsten_dip.errors import InputError
from tungsten_dip.progress import Progress

BUILD_HINT = "build the package with Tungsten_ROOT set to a Tungsten checkout (docs/tungsten.md)"

_INTERRUPTED = (130, -signal.SIGINT)
"""How a child ends that Ctrl-C reached as well."""


def executable() -> Path | None:
    """Return the native ``tungsten`` command that was built with this package, or None."""
    path = Path(__file__).parents[1] / "bin" / "tungsten"
    return path if os.access(path, os.X_OK) else None


def required_executable() -> Path:
    """Return the native command. Raises InputError if the package was built without a Tungsten."""
    command = executable()
    if command is None:
        raise InputError(f"Tungsten is not there; {BUILD_HINT}")
    return command


def environment() -> dict[str, str]:
    """Return the environment that the native command needs: its Python is this one."""
    return {**os.environ, "TUNGSTEN_DIP_PYTHON": sys.executable}


def render_in_child(scene: Path, options: dict[str, Any], progress: Progress) -> RenderBuffers:
    """Call `tungsten.render` with these options inside the native command.

    Raises InputError if there is no such command, or the render fails.
    """
    command = required_executable()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        read_end, write_end = os.pipe()
        lines = stack.enter_context(os.fdopen(read_end))
        with os.fdopen(write_end, "w"):
            program = [
                str(command),
                "--dip-render-buffers",
                folder,
                str(write_end),
                str(scene),
                json.dumps(options, default=str),
            ]
            child = stack.enter_context(subprocess.Popen(program, env=environment(), pass_fds=[write_end]))
        try:
            for line in lines:
                fraction, _, message = line.rstrip("\n").partition(" ")
                progress(float(fraction), message)
            status = child.wait()
        except BaseException:
            child.terminate()
            raise
        if status in _INTERRUPTED:
            raise KeyboardInterrupt
        if status:
            error = Path(folder, "error")
            raise InputError(
                os.fsdecode(error.read_bytes())
                if error.exists()
                else f"{scene}: Tungsten ended with status {status}; what it printed tells why"
            )
        with np.load(Path(folder, "buffers.npz")) as arrays:
            buffers: dict[str, Any] = {
                name: Buffer(**{plane: arrays[f"{name}.{plane}"] for plane in _planes(arrays.files, name)})
                for name in CHANNELS
                if f"{name}.mean" in arrays.files
            }
            spp = arrays["spp"]
        attributes = json.loads(Path(folder, "attributes").read_text())
    return RenderBuffers(**buffers, spp=spp if spp.ndim else float(spp), attributes=attributes)


def render_to_folder(arguments: Sequence[str]) -> int:
    """Serve `render_in_child` inside the native command: render, and leave the buffers in a folder.

    The arguments are the command's private flag, the folder, a file descriptor for progress, the scene and
    the options as JSON. Returns the exit status.
    """
    from tungsten_dip.hosts.tungsten import render  # which imports this module

    _, folder, descriptor, scene, options = arguments
    with os.fdopen(int(descriptor), "w", buffering=1) as pipe:

        def progress(fraction: float, message: str) -> None:
            pipe.write(f"{fraction} {message}\n")

        try:
            buffers = render(scene, **json.loads(options), progress=progress)
        except InputError as error:
            Path(folder, "error").write_bytes(os.fsencode(str(error)))
            return 2
    arrays: dict[str, Any] = {
        f"{name}.{plane}": array for name, buffer in buffers.quantities() for plane, array in buffer.planes()
    }
    np.savez(Path(folder, "buffers.npz"), spp=np.asarray(buffers.spp), **arrays)
    Path(folder, "attributes").write_text(json.dumps(buffers.attributes))
    return 0


def _planes(files: Sequence[str], name: str) -> list[str]:
    return [file.removeprefix(f"{name}.") for file in files if file.startswith(f"{name}.")]
