"""Accuracy against time: every method on every set in one run, as a table, a plot and a page."""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import numpy as np

from tungsten_dip import __version__
from tungsten_dip.bench.machine import machine_facts, machine_key
from tungsten_dip.bench.methods import Method, Outcome, Plan, methods_for
from tungsten_dip.bench.page import pareto_page
from tungsten_dip.bench.plot import require_matplotlib, write_pareto_plot
from tungsten_dip.bench.results import Key, Measurement, Results
from tungsten_dip.bench.sets import BenchSet
from tungsten_dip.bench.table import Row, SetRows, markdown_table, repeats_text
from tungsten_dip.buffers import Buffer, FloatImage, RenderBuffers, read_image, replacing, write_image
from tungsten_dip.errors import InputError
from tungsten_dip.progress import Progress, silent
from tungsten_dip.report.metrics import compare


def run_pareto(
    sets: Sequence[BenchSet], plan: Plan, folder: Path, progress: Progress = silent
) -> list[SetRows]:
    """Measure what has not been measured yet, and write what is known into the folder.

    Every measurement is written to ``results.csv`` as soon as it is there, and the image of its first repeat
    below ``images``. Those that were made before with the same settings, package version, values and machine
    are kept. In the end come ``table.md``, ``plot.svg``, ``plot.png`` and ``page.html``. KeyboardInterrupt
    loses the measurement in hand.

    Raises InputError if the folder holds something else, or a method cannot be run.
    """
    require_matplotlib()
    try:
        (folder / "images").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); choose another") from error
    results = Results(folder / "results.csv")
    methods = methods_for(sets, plan)
    machine = machine_key(plan.threads)

    def key(bench_set: BenchSet, method: Method, label: str, repeat: int) -> Key:
        return Key(bench_set.name, label, method.settings, __version__, bench_set.digest, machine, repeat)

    tasks = [
        (repeat, bench_set, method)
        for repeat in range(plan.repeats)
        for bench_set in sets
        for method in methods[bench_set.name]
        if (method.timed or repeat == 0)
    ]
    tasks = [
        (repeat, bench_set, method)
        for repeat, bench_set, method in tasks
        if any(key(bench_set, method, label, repeat) not in results for label in method.labels)
    ]
    if any(method.timed for _, _, method in tasks):
        _warm_up(sets[0], plan)
    for index, (repeat, bench_set, method) in enumerate(tasks):

        def part(fraction: float, message: str, done: int = index, what: str = method.labels[-1]) -> None:
            progress((done + fraction) / len(tasks), f"{what}: {message}")

        part(0, bench_set.name)
        with heeding_interrupts():
            outcomes = method.run(repeat, part)
        if repeat == 0:
            for outcome in outcomes:
                write_image(_image_path(folder, bench_set, outcome.label), outcome.image)
        results.add(
            _measurement(key(bench_set, method, outcome.label, repeat), outcome, bench_set)
            for outcome in outcomes
        )

    found = []
    for bench_set in sets:
        rows = []
        for method in methods[bench_set.name]:
            for label, mark in zip(method.labels, method.marks, strict=True):
                image = _image(folder, bench_set, label) if label in method.pictured else None
                median = results.medians(key(bench_set, method, label, 0), plan.repeats)
                rows.append(Row(label, mark, method.series, median, image))
        found.append(SetRows(bench_set, rows))
    _write_outputs(found, folder, plan)
    return found


@contextmanager
def heeding_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt at the end if one came, for a fit ends early on it with what it has."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed = False

    def note(number: int, frame: object) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def _measurement(key: Key, outcome: Outcome, bench_set: BenchSet) -> Measurement:
    distances = asdict(compare(outcome.image, bench_set.reference))
    return Measurement(
        key,
        outcome.seconds,
        outcome.iterations,
        **distances,
        loss=outcome.loss,
        psnr_noisy=outcome.psnr_noisy,
    )


def _warm_up(bench_set: BenchSet, plan: Plan) -> None:
    """Load every library that is measured, so that no measurement pays for it."""
    from tungsten_dip.fit import FitSettings, denoise

    corner = {
        name: Buffer(**{plane: np.ascontiguousarray(array[:16, :16]) for plane, array in buffer.planes()})
        for name, buffer in bench_set.buffers.quantities()
    }
    tiny = RenderBuffers(corner.pop("color")).with_quantities(**corner)
    denoise(tiny, FitSettings("draft", iterations=1, threads=plan.threads))
    small = Plan(("oidn",), repeats=1, threads=plan.threads)
    for method in methods_for([BenchSet("", tiny, tiny.color.mean, None, "")], small)[""]:
        method.run(0, silent)


def _image_path(folder: Path, bench_set: BenchSet, label: str) -> Path:
    return folder / "images" / (re.sub(r"[^a-z0-9]+", "-", f"{bench_set.name} {label}".lower()) + ".exr")


def _image(folder: Path, bench_set: BenchSet, label: str) -> FloatImage | None:
    """Read an image of an earlier run, unless somebody has removed it."""
    path = _image_path(folder, bench_set, label)
    return read_image(path) if path.exists() else None


def _write_outputs(found: Sequence[SetRows], folder: Path, plan: Plan) -> None:
    facts = machine_facts(plan.threads)
    tables = [f"## {each.bench_set.name}\n\n{markdown_table(each)}\n" for each in found]
    machine = "\n".join(f"- {name}: {value}" for name, value in facts)
    how = f"Seconds and distances are {repeats_text(plan.repeats)}. In bold: no faster method has a lower relMSE.\n"
    _write_text(folder / "table.md", "\n".join([*tables, how, machine, ""]))
    for suffix in ("svg", "png"):
        write_pareto_plot(folder / f"plot.{suffix}", found)
    _write_text(folder / "page.html", pareto_page(found, facts, plan.repeats))


def _write_text(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
