"""The published method's table of 13 rows on a set with a reference, and its quality over the iterations."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from tungsten_dip.bench.machine import machine_facts
from tungsten_dip.bench.methods import Method, paper_method
from tungsten_dip.bench.paper_curve import checkpoints_up_to
from tungsten_dip.bench.plot import write_iterations_plot
from tungsten_dip.bench.results import Measurement
from tungsten_dip.bench.runner import Runner, Task
from tungsten_dip.bench.sets import BenchSet
from tungsten_dip.bench.table import seconds_text
from tungsten_dip.buffers.render_buffers import RenderBuffers
from tungsten_dip.errors import InputError, whole_number
from tungsten_dip.extras import require
from tungsten_dip.fit.paper.images import paper_images
from tungsten_dip.fit.preparation.prepare import prepare_input
from tungsten_dip.fit.settings import MOST_ITERATIONS, FitSettings
from tungsten_dip.progress import Progress, silent

_LOG = logging.getLogger(__name__)

SCENES = ("cornell-box", "car2", "lamp")
"""The scenes of which all 13 rows are published."""

TOO_MANY = 10 / 3
"""Iterations of the figure over those of the table: 10000 and 3000 in the publication."""

TOO_FEW = 30
"""Iterations of the table over those of the first image of the figure."""

COLUMNS = (
    "row",
    "network",
    "channels",
    "input",
    "scheme",
    "seconds",
    "loss",
    "PSNR to noisy",
    "PSNR to truth",
    "published loss",
    "published PSNR to noisy",
    "published PSNR to truth",
)


@dataclass(frozen=True)
class PublishedRow:
    """One row of the published tables I to III. PSNRs are in dB; their truth is an NFOR-denoised image."""

    number: int
    network: str
    channels: str
    inputs: str
    scheme: str
    loss: float
    psnr_noisy: float
    psnr_truth: float

    def settings(self, iterations: int, threads: int | None) -> FitSettings:
        """Return the settings of our fit of this row."""
        fixed: dict[str, Any] = {"network": self.network, "inputs": self.inputs, "scheme": self.scheme}
        if self.network == "skip":
            fixed["channels"] = tuple(int(count) for count in self.channels.split("-"))
        return FitSettings("paper", iterations=iterations, threads=threads, **fixed)


def published_rows(scene: str) -> list[PublishedRow]:
    """Return the 13 rows of a scene in their order.

    Raises InputError if that scene has no such rows.
    """
    if scene not in SCENES:
        raise InputError(f"published scene: expected one of {', '.join(SCENES)}, got {scene}")
    text = resources.files(__package__).joinpath("published.csv").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    rows = [row for row in csv.DictReader(lines) if row["scene"] == scene]
    return [
        PublishedRow(
            number,
            row["network"],
            row["channels"],
            row["input"],
            row["scheme"].lower(),
            float(row["loss"]),
            float(row["psnr_noisy_db"]),
            float(row["psnr_truth_db"]),
        )
        for number, row in enumerate(rows, 1)
    ]


def run_paper_table(
    bench_set: BenchSet,
    folder: Path,
    *,
    scene: str,
    iterations: int,
    rows: Sequence[int] | None,
    threads: int | None,
    progress: Progress = silent,
) -> str:
    """Fit every row, and return the table in Markdown, the published figures of ``scene`` beside ours.

    ``rows`` None takes all 13, and the figure of the iterations' effect. The folder is one of a `Runner`, in
    which a run resumes; in the end it contains ``paper.md`` and ``paper.csv`` with the rows that are known
    and, with the figure, ``iterations.svg`` and ``iterations.png``.

    A row whose feature is missing is left out and logged.

    Raises InputError if a row is not one of the 13.
    """
    if rows is None:
        require("matplotlib", "the plot")
    published = published_rows(scene)
    for number in rows or ():
        whole_number("rows", number, 1, len(published))
    iterations = whole_number("iterations", iterations, 1, MOST_ITERATIONS)
    runner = Runner(folder, threads)
    buffers = prepare_input(bench_set.buffers, threads).buffers
    chosen = [
        row
        for row in published
        if (rows is None or row.number in rows)
        and _can_be_fitted(buffers, row, row.settings(iterations, threads))
    ]
    methods = {row.number: _row_method(bench_set, row, iterations, threads) for row in chosen}
    curve = _curve_method(bench_set, iterations, threads)
    tasks = [Task(bench_set, method) for method in (*methods.values(), *((curve,) if rows is None else ()))]
    runner.run(runner.missing(tasks), progress)

    found = [
        (row, runner.median(bench_set, methods[row.number], methods[row.number].labels[0])) for row in chosen
    ]
    text = _markdown(bench_set, scene, iterations, found, threads)
    runner.write_text("paper.md", text)
    runner.write_text("paper.csv", _csv(found))
    if rows is None:
        medians = [runner.median(bench_set, curve, label) for label in curve.labels]
        few = next(index for index, m in enumerate(medians) if (m.iterations or 0) * TOO_FEW >= iterations)
        best = int(np.argmax([median.psnr for median in medians]))
        images = [
            (f"{medians[index].iterations} iterations", runner.image(bench_set, curve.labels[index]))
            for index in sorted({few, best, len(medians) - 1})
        ]
        shown = [(label, image) for label, image in images if image is not None]
        write_iterations_plot(folder, bench_set, medians, shown)
    return text


def _can_be_fitted(buffers: RenderBuffers, row: PublishedRow, settings: FitSettings) -> bool:
    try:
        paper_images(buffers, settings)
    except InputError as error:
        _LOG.warning("row %d is left out: %s", row.number, error)
        return False
    return True


def _row_method(bench_set: BenchSet, row: PublishedRow, iterations: int, threads: int | None) -> Method:
    label = f"row {row.number}"
    return paper_method(bench_set, row.settings(iterations, threads), (iterations,), lambda count: label)


def _curve_method(bench_set: BenchSet, iterations: int, threads: int | None) -> Method:
    total = max(round(iterations * TOO_MANY), iterations + 1)
    counts = checkpoints_up_to(total, first=min(10, iterations))
    settings = FitSettings("paper", threads=threads)
    return paper_method(bench_set, settings, counts, lambda count: f"after {count} iterations")


def _markdown(
    bench_set: BenchSet,
    scene: str,
    iterations: int,
    found: Sequence[tuple[PublishedRow, Measurement]],
    threads: int | None,
) -> str:
    lines = ["| " + " | ".join(COLUMNS) + " |", "|--:|---|---|---|---" + "|--:" * 7 + "|"]
    for row, ours in found:
        cells = (
            str(row.number),
            row.network,
            row.channels,
            row.inputs,
            row.scheme.upper(),
            seconds_text(ours.seconds),
            f"{ours.loss:.6f}",
            f"{ours.psnr_noisy:.2f}",
            f"{ours.psnr:.2f}",
            f"{row.loss:.6f}",
            f"{row.psnr_noisy:.2f}",
            f"{row.psnr_truth:.2f}",
        )
        lines.append("| " + " | ".join(cells) + " |")
    size = f"{bench_set.buffers.width} x {bench_set.buffers.height} pixels"
    machine = "; ".join(f"{name} {value}" for name, value in machine_facts(threads))
    return "\n".join(
        [
            f"{bench_set.name}, {size}, {iterations} iterations, PSNR in dB of displayed images.",
            "",
            *lines,
            "",
            "Loss and PSNR to noisy are of the last iteration's output, PSNR to truth is of the average of "
            f"all. The published figures are those of {scene}; the truth there is an NFOR-denoised image, "
            "here it is the set's reference.",
            "",
            f"Measured with: {machine}.",
            "",
        ]
    )


def _csv(found: Sequence[tuple[PublishedRow, Measurement]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(name.replace(" ", "_").lower() for name in COLUMNS)
    for row, ours in found:
        described = (row.number, row.network, row.channels, row.inputs, row.scheme)
        measured = (ours.seconds, ours.loss, ours.psnr_noisy, ours.psnr)
        writer.writerow((*described, *measured, row.loss, row.psnr_noisy, row.psnr_truth))
    return stream.getvalue()
