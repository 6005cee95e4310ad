"""Runs methods that have not been run yet, and saves every result as soon as it is there."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from tungsten_dip import __version__
from tungsten_dip.bench.machine import machine_key
from tungsten_dip.bench.methods import Method, Outcome
from tungsten_dip.bench.results import Key, Measurement, Results
from tungsten_dip.bench.sets import BenchSet
from tungsten_dip.buffers.atomic import write_text
from tungsten_dip.buffers.image_file import write_image
from tungsten_dip.buffers.read import read_image
from tungsten_dip.buffers.render_buffers import FloatImage
from tungsten_dip.errors import InputError
from tungsten_dip.progress import Progress, part_of
from tungsten_dip.report.metrics import compare


@dataclass(frozen=True)
class Task:
    """One run of a method on a set."""

    bench_set: BenchSet
    method: Method
    repeat: int = 0


class Runner:
    """A folder of measurements (``results.csv``) and of the images of their first repeats (``images``).

    Measurements that an earlier run left there count if the settings, the package's version, the values of
    the set and the machine are the same.
    """

    def __init__(self, folder: Path, threads: int | None) -> None:
        """Open the folder, which is created if needed.

        Raises InputError if it cannot be written or holds something else.
        """
        try:
            (folder / "images").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be written ({error.strerror}); choose another") from error
        self._folder = folder
        self._results = Results(folder / "results.csv")
        self._machine = machine_key(threads)

    def missing(self, tasks: Sequence[Task]) -> list[Task]:
        """Return the tasks that have not been run."""
        return [
            task
            for task in tasks
            if any(self._key(task, label) not in self._results for label in task.method.labels)
        ]

    def run(self, tasks: Sequence[Task], progress: Progress) -> None:
        """Run the tasks in turn. KeyboardInterrupt loses only the current task."""
        for index, task in enumerate(tasks):
            start, end = index / len(tasks), (index + 1) / len(tasks)
            part = part_of(progress, start, end, task.method.labels[-1])
            part(0, task.bench_set.name)
            outcomes = task.method.run(task.repeat, part)
            if task.repeat == 0:
                for outcome in outcomes:
                    write_image(self._image_path(task.bench_set, outcome.label), outcome.image)
            self._results.add(self._measurement(task, outcome) for outcome in outcomes)

    def median(self, bench_set: BenchSet, method: Method, label: str, repeats: int = 1) -> Measurement:
        """Return the medians of a label's repeats."""
        return self._results.medians(self._key(Task(bench_set, method), label), repeats)

    def image(self, bench_set: BenchSet, label: str) -> FloatImage | None:
        """Return the image of a label's first repeat, or None if its file was removed."""
        path = self._image_path(bench_set, label)
        return read_image(path) if path.exists() else None

    def write_text(self, name: str, text: str) -> None:
        """Write a file into the folder, whole or not at all."""
        write_text(self._folder / name, text)

    def _key(self, task: Task, label: str) -> Key:
        bench_set, settings = task.bench_set, task.method.settings
        return Key(bench_set.name, label, settings, __version__, bench_set.digest, self._machine, task.repeat)

    def _measurement(self, task: Task, outcome: Outcome) -> Measurement:
        return Measurement(
            key=self._key(task, outcome.label),
            seconds=outcome.seconds,
            iterations=outcome.iterations,
            **asdict(compare(outcome.image, task.bench_set.reference)),
            loss=outcome.loss,
            psnr_noisy=outcome.psnr_noisy,
        )

    def _image_path(self, bench_set: BenchSet, label: str) -> Path:
        # Several sets in one folder may have the same name, hence the digest.
        name = re.sub(r"[^a-z0-9]+", "-", f"{bench_set.name} {bench_set.digest[:8]} {label}".lower())
        return self._folder / "images" / f"{name}.exr"
