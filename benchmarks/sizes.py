"""What an image's size costs: seconds, microseconds per pixel, and the peak memory of the whole command.

    python benchmarks/sizes.py renders/living-room/n16 512x288 1920x1080 3840x2160

prints a Markdown table. The image is repeated side by side until it fills a size.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from tungsten_dip.buffers.image_file import read_attributes
from tungsten_dip.buffers.read import read_buffers
from tungsten_dip.buffers.render_buffers import Buffer, RenderBuffers
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.errors import InputError


def main() -> None:
    """Denoise an image of every size, and print a row for it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("input", type=Path)
    parser.add_argument("sizes", metavar="WIDTHxHEIGHT", nargs="+")
    parser.add_argument("--preset", default="balanced", choices=["draft", "balanced", "final"])
    options = parser.parse_args()
    buffers = read_buffers(options.input)
    print("| | s | us per pixel | GiB |")
    print("|---|---|---|---|")
    for size in options.sizes:
        width, height = (int(number) for number in size.split("x"))
        seconds, gib = _measured(_filling(buffers, width, height), options.preset)
        print(f"| {size} | {seconds:.3g} | {1e6 * seconds / (width * height):.3g} | {gib:.3g} |", flush=True)


def _filling(buffers: RenderBuffers, width: int, height: int) -> RenderBuffers:
    """Return the buffers repeated until they fill the size."""
    times = (-(-height // buffers.height), -(-width // buffers.width), 1)

    def filling(buffer: Buffer) -> Buffer:
        planes = {name: np.tile(plane, times)[:height, :width].copy() for name, plane in buffer.planes()}
        return Buffer(**planes)

    features = {quantity: filling(buffer) for quantity, buffer in buffers.quantities()}
    return RenderBuffers(features.pop("color")).with_quantities(**features)


def _measured(buffers: RenderBuffers, preset: str) -> tuple[float, float]:
    """Return the seconds of a fit, and the peak memory in GiB of the command that runs it."""
    with tempfile.TemporaryDirectory() as folder:
        written, output = Path(folder, "buffers"), Path(folder, "denoised.exr")
        write_tungsten_folder(written, buffers)
        command = [sys.executable, "-m", "tungsten_dip", "denoise"]
        command += [str(written), "-o", str(output), "--preset", preset]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        # Not wait(): of several commands, only this tells how much memory each of them took.
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise InputError(f"denoise ended with status {process.returncode}")
        return float(read_attributes(output)["tungsten_dip/seconds"]), usage.ru_maxrss / 2**20


if __name__ == "__main__":
    try:
        main()
    except InputError as problem:
        sys.exit(f"{sys.argv[0]}: {problem}")
