"""How accurate the estimated error is: the estimate over the error, and how the maps of both agree.

    python benchmarks/calibration.py --spp-ratio 0.004 cornell-box/n4=cornell-box/reference.exr ...

prints a Markdown table. A reference has noise of its own, which counts as error of every image: by the ratio
of the samples of the sets to those of their references, it follows from the noisy image and is taken out.
"""

import argparse
import sys

import numpy as np
import numpy.typing as npt

from tungsten_dip.bench.sets import BenchSet, read_sets
from tungsten_dip.buffers.relmse import relative_squared_error
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.report.preview import block_means

BLOCK = 8


def main() -> None:
    """Denoise every set, and print a row for it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", metavar="SET=REFERENCE", nargs="+")
    parser.add_argument("--spp-ratio", type=float, required=True, help="spp of the sets over the references'")
    parser.add_argument("--preset", default="balanced", choices=["draft", "balanced", "final"])
    options = parser.parse_args()
    sets = read_sets(options.sets)
    print("| set | relMSE | without the reference's noise | estimated | over the latter | rank correlation |")
    print("|---|---|---|---|---|---|")
    for bench_set in sets:
        print(_row(bench_set, FitSettings(options.preset), options.spp_ratio), flush=True)


def _row(bench_set: BenchSet, settings: FitSettings, ratio: float) -> str:
    result = denoise(bench_set.buffers, settings)
    if result.error is None or result.estimated_relmse is None:
        raise InputError(f"{bench_set.name}: expected independent halves, from which the error is estimated")
    reference = bench_set.reference
    error = relative_squared_error(result.color, reference)
    # The noisy image's error is its own noise and the reference's, which is less by the ratio.
    noisy = float(relative_squared_error(bench_set.buffers.color.mean, reference).mean())
    own = noisy * ratio / (1 + ratio)
    true = float(error.mean()) - own
    rank = np.corrcoef(_ranks(error.mean(axis=2)), _ranks(result.error[:, :, 0]))[0, 1]
    return (
        f"| {bench_set.name} | {error.mean():.5f} | {true:.5f} | {result.estimated_relmse:.5f} | "
        f"{result.estimated_relmse / true:.2f} | {rank:.2f} |"
    )


def _ranks(image: npt.NDArray[np.floating]) -> npt.NDArray[np.intp]:
    """Rank blocks of `BLOCK` pixels each way by their means."""
    return np.argsort(np.argsort(block_means(image, BLOCK), axis=None))


if __name__ == "__main__":
    try:
        main()
    except InputError as problem:
        sys.exit(f"{sys.argv[0]}: {problem}")
