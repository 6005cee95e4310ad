"""Tungsten's own denoiser as a peer.

Bitterli et al., "Nonlinearly Weighted First-order Regression for Denoising Monte Carlo
Renderings", EGSR 2016.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from tungsten_dip.buffers.read import read_image
from tungsten_dip.buffers.render_buffers import FloatImage, RenderBuffers
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.errors import InputError


def nfor_image(buffers: RenderBuffers, denoiser: Path) -> FloatImage:
    """Return the image that Tungsten's command ``denoiser`` computes from the buffers, linear radiance.

    Features of which a half or the variance is missing are left out, since the command cannot do without.

    Raises InputError if the colour lacks its halves or variance, or the command fails.
    """
    if buffers.color.halves is None or buffers.color.variance is None:
        raise InputError("NFOR: expected a colour with halves A and B and its variance; save them as well")
    left_out: dict[str, Any] = {
        name: None
        for name, buffer in buffers.quantities()
        if buffer.halves is None or buffer.variance is None or name == "visibility"
    }
    buffers = replace(buffers, **left_out, alpha=None, spp=None)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_tungsten_folder(folder, buffers)
        scene = folder / "scene.json"
        scene.write_text(json.dumps(_scene(buffers)), encoding="utf-8")
        output = folder / "denoised.exr"
        try:
            done = subprocess.run(
                [denoiser.resolve(), scene, output], capture_output=True, text=True, check=False
            )
        except OSError as error:
            raise InputError(
                f"{denoiser}: cannot be run ({error.strerror}); name Tungsten's denoiser"
            ) from error
        if done.returncode != 0 or not output.exists():
            message = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
            raise InputError(f"{denoiser}: failed with status {done.returncode} ({message}); leave it out")
        return read_image(output)


def _scene(buffers: RenderBuffers) -> dict[str, object]:
    """Return a scene that holds nothing but the names of its buffers."""
    return {
        "bsdfs": [],
        "primitives": [],
        "camera": {"type": "pinhole", "resolution": [buffers.width, buffers.height]},
        "integrator": {"type": "path_tracer"},
        "renderer": {
            "output_buffers": [
                {
                    "type": quantity,
                    "hdr_output_file": f"{quantity}.exr",
                    "two_buffer_variance": True,
                    "sample_variance": True,
                }
                for quantity, _ in buffers.quantities()
            ]
        },
    }
