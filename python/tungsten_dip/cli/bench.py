"""The commands ``tungsten-dip bench ...``: what accuracy costs in time, measured on this machine."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tungsten_dip.cli.console import add_json, add_threads, duration, integers, progress_on_stderr
from tungsten_dip.cli.denoising import add_map, layer_mapping
from tungsten_dip.cli.outcome import Outcome
from tungsten_dip.fit.paper.constants import ITERATIONS

if TYPE_CHECKING:
    from argparse import _SubParsersAction

SETS_HELP = (
    "buffers as for denoise, with their reference as INPUT=REFERENCE.exr, or with a reference.exr in their "
    "folder or the one above"
)


def add_bench(commands: _SubParsersAction[Any]) -> None:
    """Add ``bench`` and its own commands."""
    bench = commands.add_parser(
        "bench", help="measure accuracy against time, and against the published method"
    )
    benches = bench.add_subparsers(required=True, metavar="WHAT", title="what to measure")

    pareto = benches.add_parser("pareto", help="our fits, other denoisers and more samples, on the same axes")
    pareto.set_defaults(action=_pareto)
    add = pareto.add_argument
    _add_common(pareto, "bench")
    add("--methods", metavar="M,M,...", type=_names, help="of presets, budgets, paper, oidn, nfor, samples")
    add("--presets", metavar="P,P,...", type=_names, help="which presets (default: draft,balanced,final)")
    add(
        "--budgets", metavar="S,S,...", type=_durations, help="time budgets of final (default: 2s,5s,10s,20s)"
    )
    add("--paper-iterations", metavar="N", type=int, help=f"of the published method (default: {ITERATIONS})")
    add("--nfor-seconds", metavar="S", type=duration, help="what the nfor.exr beside the buffers took")
    add("--denoiser", metavar="PATH", type=Path, help="Tungsten's command denoiser, to measure NFOR with")
    add(
        "--scene",
        metavar="SCENE",
        type=Path,
        action="append",
        default=[],
        help="the scene of a SET, in their order: renders more samples instead of denoising",
    )
    add("--repeats", metavar="N", type=int, help="how often every method is run, in turns (default: 3)")

    paper = benches.add_parser("paper", help="the published method's table of 13 rows, beside its figures")
    paper.set_defaults(action=_paper)
    add = paper.add_argument
    _add_common(paper, "bench-paper", one=True)
    add(
        "--iterations",
        metavar="N",
        type=int,
        default=ITERATIONS,
        help=f"of every row (default: {ITERATIONS})",
    )
    add("--rows", metavar="N,N,...", type=integers, help="only these rows, from 1 to 13, and no figure")
    add("--crop", action="store_true", help="take the middle, in multiples of 32 pixels, as published")
    add("--published", metavar="SCENE", help="the published scene: cornell-box (default), car2 or lamp")

    iteration = benches.add_parser(
        "iteration", help="the published method's iteration, against plain PyTorch"
    )
    iteration.set_defaults(action=_iteration)
    add = iteration.add_argument
    add("--size", metavar="WxH", type=_size, default=(512, 288), help="multiples of 32 (default: 512x288)")
    add("--iterations", metavar="N", type=int, default=10, help="per repeat (default: 10)")
    add("--repeats", metavar="N", type=int, default=5, help="in turns (default: 5)")
    add_threads(iteration)
    add_json(iteration)


def _add_common(parser: argparse.ArgumentParser, folder: str, one: bool = False) -> None:
    add = parser.add_argument
    add("sets", metavar="SET", nargs=1 if one else "+", help=SETS_HELP)
    add(
        "-o",
        "--output",
        metavar="FOLDER",
        type=Path,
        default=Path(folder),
        help=f"where results are, and a run goes on (default: {folder})",
    )
    add_map(parser)
    add_threads(parser)
    add_json(parser)


def _pareto(options: argparse.Namespace) -> Outcome:
    from tungsten_dip.bench.methods import Plan
    from tungsten_dip.bench.pareto import run_pareto
    from tungsten_dip.bench.sets import read_sets
    from tungsten_dip.bench.table import markdown_table

    given = {
        "kinds": options.methods,
        "presets": options.presets,
        "budgets_s": options.budgets,
        "paper_iterations": options.paper_iterations,
        "nfor_s": options.nfor_seconds,
        "denoiser": options.denoiser,
        "scenes": tuple(options.scene),
        "repeats": options.repeats,
        "threads": options.threads,
    }
    plan = Plan(**{name: value for name, value in given.items() if value is not None})
    sets = read_sets(options.sets, layer_mapping(options))
    with progress_on_stderr("measuring") as progress:
        found = run_pareto(sets, plan, options.output, progress)
    facts = {
        each.bench_set.name: [{"label": row.label, **asdict(row.median)} for row in each.rows]
        for each in found
    }
    tables = "\n\n".join(f"{each.bench_set.name}\n\n{markdown_table(each)}" for each in found)
    return Outcome(facts, f"{tables}\n\n{options.output / 'page.html'} shows them")


def _paper(options: argparse.Namespace) -> Outcome:
    from tungsten_dip.bench.paper_table import SCENES, run_paper_table
    from tungsten_dip.bench.sets import cropped_as_published, read_sets

    (bench_set,) = read_sets(options.sets, layer_mapping(options))
    if options.crop:
        bench_set = cropped_as_published(bench_set)
    with progress_on_stderr("fitting") as progress:
        text = run_paper_table(
            bench_set,
            options.output,
            scene=options.published or SCENES[0],
            iterations=options.iterations,
            rows=options.rows,
            threads=options.threads,
            progress=progress,
        )
    return Outcome({"output": str(options.output), "table": text}, text)


def _iteration(options: argparse.Namespace) -> Outcome:
    from tungsten_dip.bench.iteration import time_iterations, times_text

    width, height = options.size
    with progress_on_stderr("timing") as progress:
        times = time_iterations(
            width,
            height,
            iterations=options.iterations,
            repeats=options.repeats,
            threads=options.threads,
            progress=progress,
        )
    facts = {**asdict(times), "speedup": times.speedup}
    return Outcome(facts, times_text(times, width, height, options.threads))


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


def _durations(text: str) -> tuple[float, ...]:
    return tuple(duration(part) for part in text.split(","))


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"expected a size such as 512x288, got '{text}'")
    return int(width), int(height)
