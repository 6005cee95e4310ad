"""What each part of the preset balanced contributes: PSNR, relMSE, FLIP and seconds without it.

    python benchmarks/ablation.py renders/cornell-box/n4=renders/cornell-box/reference.exr ...

prints a Markdown table, one row per variant. Run it on a machine with nothing else to do.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

from tungsten_dip.bench.sets import read_sets
from tungsten_dip.buffers import prefilter
from tungsten_dip.errors import InputError
from tungsten_dip.fit import FitSettings, denoise, evidence
from tungsten_dip.fit.layout import Pilot
from tungsten_dip.fit.output import all_samples
from tungsten_dip.fit.pilots import maker, surfaces
from tungsten_dip.fit.presets import RECIPES
from tungsten_dip.report.metrics import compare

BALANCED = RECIPES["balanced"]

Change = Callable[[], AbstractContextManager[object]]


def _recipe(**changes: Any) -> Change:
    return lambda: mock.patch.dict(RECIPES, balanced=replace(BALANCED, **changes))


def _without(unwanted: Callable[[Pilot], bool]) -> Change:
    return _recipe(pilots=tuple(pilot for pilot in BALANCED.pilots if not unwanted(pilot)))


@contextmanager
def _with_occupied_space() -> Iterator[None]:
    with (
        mock.patch.object(evidence, "occupied_pixels", return_value=1),
        mock.patch.object(all_samples, "occupied_pixels", return_value=1),
    ):
        yield


VARIANTS: dict[str, Change] = {
    "balanced": _recipe(),
    "hardly trained (1 step)": _recipe(steps=1),
    "one network instead of two": _recipe(members=1),
    "one pilot and the noisy image": _recipe(pilots=(Pilot("guided", 10, step=2, k=1.0),)),
    "no guided pilots": _without(lambda pilot: pilot.k is not None),
    "only guided pilots": _without(lambda pilot: pilot.kind == "features"),
    "guided pilots not averaged along edges": lambda: mock.patch.object(maker, "_GUIDED_SIGMA", 0.01),
    "no regression on the position": _without(lambda pilot: pilot.with_position),
    "no mean along edges as a pilot": _without(lambda pilot: pilot.kind == "edges"),
    "no pilot that sees only the colour": _without(lambda pilot: pilot.kind == "color"),
    "features filtered in one pass": lambda: mock.patch.object(prefilter, "_PASSES", ((5, 1, 0.5),)),
    "emitted light not smoothed along edges": lambda: mock.patch.object(
        surfaces, "_smooth_emission", lambda emission, filtered, *_: filtered
    ),
    "no pilots of all samples": _recipe(all_samples=False),
    "empty space like any other": _with_occupied_space,
}


def main() -> None:
    """Measure every variant on every set, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", metavar="SET=REFERENCE", nargs="+")
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    sets = read_sets(options.sets)
    print("| variant |", *(f"{Path(s.name)} |" for s in sets), "seconds |")
    print("|---|" + "---|" * (len(sets) + 1))
    settings = FitSettings(threads=options.threads)
    denoise(sets[0].buffers, replace(settings, iterations=1))
    for name, change in VARIANTS.items():
        cells, seconds = [], 0.0
        for bench_set in sets:
            with change():
                start = time.perf_counter()
                result = denoise(bench_set.buffers, settings)
                seconds += time.perf_counter() - start
            found = compare(result.color, bench_set.reference)
            cells.append(f"{found.psnr:.2f} / {found.relmse:.4f} / {found.flip:.4f} |")
        print(f"| {name} |", *cells, f"{seconds / len(sets):.1f} |", flush=True)


if __name__ == "__main__":
    try:
        main()
    except InputError as problem:
        sys.exit(f"{sys.argv[0]}: {problem}")
