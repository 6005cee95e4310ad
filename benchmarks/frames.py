"""How good a denoised sequence is: mean PSNR, relMSE, FLIP and flicker, by the references of its frames.

    python benchmarks/frames.py 'references/f####.exr' 'cold/f####.exr' 'followed/f####.exr' ...

prints a Markdown table with a row per sequence. The first frame counts only as the one before the second.
"""

import argparse
import sys
from itertools import pairwise

import numpy as np

from tungsten_dip.buffers.read import read_image
from tungsten_dip.buffers.render_buffers import FloatImage
from tungsten_dip.errors import InputError
from tungsten_dip.report.metrics import compare
from tungsten_dip.sequence.flicker import flicker
from tungsten_dip.sequence.frames import find_frames


def main() -> None:
    """Compare every sequence with the references, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("references", metavar="REFERENCES")
    parser.add_argument("sequences", metavar="FRAMES", nargs="+")
    options = parser.parse_args()
    references = _images(options.references)
    print("| | PSNR | relMSE | FLIP | flicker |")
    print("|---|---|---|---|---|")
    for pattern in options.sequences:
        images = _images(pattern)
        if len(images) < 2:
            raise InputError(f"{pattern}: expected two frames or more, found {len(images)}")
        for number in images.keys() - references.keys():
            raise InputError(f"{pattern}: there is no reference of frame {number} in {options.references}")
        found = [compare(image, references[number]) for number, image in images.items()][1:]
        flickers = [
            flicker(images[n], images[before], references[n], references[before])
            for before, n in pairwise(images)
        ]
        psnr, relmse, flip = (
            np.mean([getattr(one, name) for one in found]) for name in ("psnr", "relmse", "flip")
        )
        print(f"| {pattern} | {psnr:.2f} | {relmse:.5f} | {flip:.4f} | {np.mean(flickers):.5f} |")


def _images(pattern: str) -> dict[int, FloatImage]:
    return {frame.number: read_image(frame.input) for frame in find_frames(pattern, pattern)}


if __name__ == "__main__":
    try:
        main()
    except InputError as problem:
        sys.exit(f"{sys.argv[0]}: {problem}")
