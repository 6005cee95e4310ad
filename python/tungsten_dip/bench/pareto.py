"""Accuracy against time: every method on every set in one run, as a table, a plot and a page."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from pathlib import Path

from tungsten_dip.bench.machine import machine_facts
from tungsten_dip.bench.methods import IN_TIME, OIDN, OURS, PAPER, SAMPLES, Plan, methods_for
from tungsten_dip.bench.page import pareto_page
from tungsten_dip.bench.plot import write_pareto_plot
from tungsten_dip.bench.runner import Runner, Task
from tungsten_dip.bench.sets import BenchSet, cropped
from tungsten_dip.bench.table import Row, SetRows, markdown_table, repeats_text
from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.extras import require
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.fit.pilots.oidn import oidn_image
from tungsten_dip.hosts import render
from tungsten_dip.progress import Progress, silent


def run_pareto(
    sets: Sequence[BenchSet], plan: Plan, folder: Path, progress: Progress = silent
) -> list[SetRows]:
    """Measure what the folder does not hold yet (`Runner`), and show all of it.

    In the end come ``table.md``, ``plot.svg``, ``plot.png`` and ``page.html``. KeyboardInterrupt loses the
    measurement in hand.

    Raises InputError if the folder holds something else, or a method cannot be run.
    """
    require("matplotlib", "the plot")
    methods = methods_for(sets, plan)
    runner = Runner(folder, plan.threads)
    tasks = runner.missing(
        [
            Task(bench_set, method, repeat)
            for repeat in range(plan.repeats)
            for bench_set in sets
            for method in methods[bench_set.name]
            if (method.timed or repeat == 0)
        ]
    )
    _warm_up(sets[0], plan, {task.method.series for task in tasks})
    runner.run(tasks, progress)

    found = []
    for bench_set in sets:
        rows = []
        for method in methods[bench_set.name]:
            for label, mark in zip(method.labels, method.marks, strict=True):
                image = runner.image(bench_set, label) if label in method.pictured else None
                median = runner.median(bench_set, method, label, plan.repeats)
                rows.append(Row(label, mark, method.series, median, image))
        found.append(SetRows(bench_set, rows))

    facts = machine_facts(plan.threads)
    tables = [f"## {each.bench_set.name}\n\n{markdown_table(each)}\n" for each in found]
    how = f"Figures: {repeats_text(plan.repeats)}. In bold: no faster method has a lower relMSE.\n"
    machine = "\n".join(f"- {name}: {value}" for name, value in facts)
    runner.write_text("table.md", "\n".join([*tables, how, machine, ""]))
    write_pareto_plot(folder, found)
    runner.write_text("page.html", pareto_page(found, facts, plan.repeats))
    return found


def _warm_up(bench_set: BenchSet, plan: Plan, series: Collection[str]) -> None:
    """Load every library that is about to be measured, so that no measurement includes it."""
    height, width = bench_set.buffers.height, bench_set.buffers.width
    middle = [slice(max(0, size // 2 - 32), size // 2 + 32) for size in (height, width)]
    tiny = cropped(bench_set.buffers, (middle[0], middle[1]))
    logger = logging.getLogger("tungsten_dip")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)  # of results that are discarded
    try:
        _warm_up_with(tiny, plan, series)
    finally:
        logger.setLevel(level)


def _warm_up_with(tiny: RenderBuffers, plan: Plan, series: Collection[str]) -> None:
    if not {OURS, IN_TIME}.isdisjoint(series):
        denoise(tiny, FitSettings("draft", iterations=1, threads=plan.threads))
    if PAPER in series:
        denoise(tiny, FitSettings("paper", iterations=1, threads=plan.threads))
    if OIDN in series:
        oidn_image(tiny.color.mean, threads=plan.threads)
    if SAMPLES in series:
        render(plan.scenes[0], spp=1, threads=plan.threads)
