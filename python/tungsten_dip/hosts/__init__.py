"""Who renders: Tungsten itself where the package was built against it, or Mitsuba 3 with our plugins."""

from __future__ import annotations

import logging
import threading
from pathlib import Path
from typing import Literal, get_args

from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.errors import check_choice
from tungsten_dip.hosts import tungsten
from tungsten_dip.hosts.mitsuba.render import render as render_with_mitsuba
from tungsten_dip.progress import Progress, silent
from tungsten_dip.scene.parse import load_scene
from tungsten_dip.scene.types import Scene

_LOG = logging.getLogger(__name__)

_RENDERING = threading.Lock()
"""Both hosts keep some of their state in globals of the process."""

Host = Literal["auto", "tungsten", "mitsuba"]


def chosen_host(host: Host) -> Literal["tungsten", "mitsuba"]:
    """Return who renders, of "auto" what `render` says."""
    if host != "auto":
        return host
    return "tungsten" if tungsten.available() else "mitsuba"


def render(
    scene: Scene | Path | str,
    host: Host = "auto",
    spp: int | None = None,
    seed: int | None = None,
    threads: int | None = None,
    progress: Progress = silent,
) -> RenderBuffers:
    """Render a scene, given itself or its file, and return colour and features with independent halves.

    ``host`` "auto" is Tungsten where the package was built against it, else Mitsuba. None takes the scene's
    ``spp``, and the host's own seed and number of threads. Writes no file. Of several threads one renders
    at a time. Tungsten reads the file of a `Scene` itself, whatever was changed in memory.

    Raises InputError if the scene or the host cannot be used, or the picture would not fit into memory.
    """
    check_choice("host", host, get_args(Host))
    host = chosen_host(host)
    path, folder = (scene.path, scene.input_directory) if isinstance(scene, Scene) else (scene, None)
    _LOG.info("%s: rendered by %s", path, host.capitalize())
    with _RENDERING:
        if host == "tungsten":
            # Which may read scenes that `load_scene` refuses.
            return tungsten.render(
                path, spp=spp, seed=seed, threads=threads, input_directory=folder, progress=progress
            )
        if not isinstance(scene, Scene):
            scene = load_scene(scene)
        return render_with_mitsuba(
            scene, spp=spp, seed=0 if seed is None else seed, threads=threads, progress=progress
        )
