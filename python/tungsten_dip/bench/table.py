"""The results of every set: medians as rows, in Markdown and as texts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tungsten_dip.bench.results import Measurement
from tungsten_dip.bench.sets import BenchSet
from tungsten_dip.buffers.render_buffers import FloatImage

COLUMNS = ("method", "seconds", "PSNR, dB", "relMSE", "FLIP", "HDR-FLIP", "mean ratio")


@dataclass(frozen=True)
class Row:
    """The medians of one label of a `Method`, and its image where the page shows it."""

    label: str
    mark: str
    series: str
    median: Measurement
    image: FloatImage | None


@dataclass(frozen=True)
class SetRows:
    """All rows of one set."""

    bench_set: BenchSet
    rows: list[Row]

    def front(self) -> list[int]:
        """Return the indices of the rows than which no faster one has a lower relMSE."""
        timed = [
            (row.median.seconds, row.median.relmse, index)
            for index, row in enumerate(self.rows)
            if row.median.seconds is not None
        ]
        best, front = np.inf, []
        for _, relmse, index in sorted(timed):
            if relmse < best:
                best = relmse
                front.append(index)
        return sorted(front)


def markdown_table(rows: SetRows) -> str:
    """Return the rows as a table in Markdown, those of the front in bold."""
    front = rows.front()
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---" + "|--:" * (len(COLUMNS) - 1) + "|"]
    for index, row in enumerate(rows.rows):
        label, *numbers = cells(row)
        lines.append(f"| {f'**{label}**' if index in front else label} | " + " | ".join(numbers) + " |")
    return "\n".join(lines)


def cells(row: Row) -> list[str]:
    """Return the texts of one row of the table."""
    median = row.median
    numbers = (
        (median.psnr, ".2f"),
        (median.relmse, "#.3g"),
        (median.flip, ".4f"),
        (median.hdrflip, ".4f"),
        (median.mean_ratio, ".3f"),
    )
    label = f"{row.label} ({median.nonfinite} values not finite)" if median.nonfinite else row.label
    return [
        label,
        seconds_text(median.seconds),
        *("" if value is None else format(value, form).rstrip(".") for value, form in numbers),
    ]


def seconds_text(seconds: float | None) -> str:
    """Return seconds with two digits, or an empty text if unknown."""
    if seconds is None:
        return ""
    return f"{seconds:#.2g}" if seconds < 10 else f"{seconds:.0f}"


def repeats_text(repeats: int) -> str:
    """Return how many runs a figure comes from."""
    return "one run each" if repeats == 1 else f"medians of {repeats} interleaved runs"
