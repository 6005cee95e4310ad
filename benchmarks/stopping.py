"""Where a fit stops: PSNR of its last image, and how far the best image of the same run is above it.

    python benchmarks/stopping.py renders/cornell-box/n4=renders/cornell-box/reference.exr ...

prints a Markdown table. The image is compared every 20 steps: the blend of the halves' candidates, to
which neither lost detail nor the pilots of all samples have been added.
"""

import argparse
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tungsten_dip.bench.sets import BenchSet, read_sets
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitSettings, blending, denoise
from tungsten_dip.fit.network.blend_network import BlendNetwork, Examples
from tungsten_dip.fit.network.training import Start, start_of_training
from tungsten_dip.fit.settings import Preset
from tungsten_dip.report.metrics import compare

PRESETS: tuple[Preset, ...] = ("draft", "balanced")
EVERY = 20


def psnrs(bench_set: BenchSet, preset: Preset, seed: int) -> list[float]:
    """Return the PSNR in dB after every `EVERY` steps of a fit."""
    found: list[float] = []
    starts: list[Start] = []

    class Watched(BlendNetwork):
        steps = 0

        def step(self, batch: Examples, learning_rate: float) -> None:
            super().step(batch, learning_rate)
            self.steps += 1
            if self.steps % EVERY == 0:
                evidence, examples = starts[-1].evidence, starts[-1].examples
                of_halves = [
                    self.blend(examples.of_half(half).inputs, evidence.candidates.of_half(half))
                    for half in (0, 1)
                ]
                image = np.float32(0.5 / evidence.scale) * (of_halves[0] + of_halves[1])
                found.append(compare(image.reshape(evidence.mean.shape), bench_set.reference).psnr)

    def start(*arguments: Any) -> Start:
        starts.append(start_of_training(*arguments))
        return starts[-1]

    with (
        mock.patch.object(blending, "BlendNetwork", Watched),
        mock.patch.object(blending, "start_of_training", start),
    ):
        denoise(bench_set.buffers, FitSettings(preset, seed=seed))
    return found


def main() -> None:
    """Watch every preset on every set, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", metavar="SET=REFERENCE", nargs="+")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    sets = read_sets(options.sets)
    print("| |", *(f"{Path(s.name)} |" for s in sets))
    print("|---|" + "---|" * len(sets))
    for preset in PRESETS:
        curves = [psnrs(bench_set, preset, options.seed) for bench_set in sets]
        cells = (f"{curve[-1]:.2f} ({max(curve) - curve[-1]:.2f}) |" for curve in curves)
        print(f"| {preset}, {EVERY * len(curves[0])} steps |", *cells, flush=True)


if __name__ == "__main__":
    try:
        main()
    except InputError as problem:
        sys.exit(f"{sys.argv[0]}: {problem}")
