"""The command ``tungsten-dip sequence``: denoise an animation's frames, here or on a cluster."""

from __future__ import annotations

import argparse
import hashlib
import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from tungsten_dip.buffers.atomic import check_suffix, check_writable, write_text
from tungsten_dip.buffers.read import input_files
from tungsten_dip.cli.console import add_json, add_threads, progress_on_stderr
from tungsten_dip.cli.denoising import (
    FIT_OPTIONS,
    add_file_options,
    add_fit_options,
    check_outputs_are_not_inputs,
    fit_settings,
    layer_mapping,
    load_warm_start,
)
from tungsten_dip.cli.outcome import Outcome
from tungsten_dip.cores import MOST_THREADS
from tungsten_dip.errors import InputError, whole_number
from tungsten_dip.fit.settings import Preset
from tungsten_dip.interrupts import deferred_interrupts

if TYPE_CHECKING:
    from argparse import _SubParsersAction

    from tungsten_dip.sequence.following import Models
    from tungsten_dip.sequence.frames import Frame
    from tungsten_dip.sequence.work import OnRecord, Record, Run

_LOG = logging.getLogger(__name__)

_PRESETS = tuple(preset for preset in get_args(Preset) if preset != "paper")
"""Frames of the published method do not follow one another."""

_TOLD_OF_EVERY_FRAME = tuple(
    f"tungsten_dip.{name}" for name in ("buffers", "fit", "onnx", "sequence.cluster")
)
"""The loggers of what is read and fitted, here or by workers."""


def add_sequence(commands: _SubParsersAction[Any]) -> None:
    """Add ``sequence``."""
    sequence = commands.add_parser(
        "sequence", help="denoise the frames of an animation, each from the one before"
    )
    sequence.set_defaults(action=_sequence)
    add = sequence.add_argument
    add("input", metavar="'IN/f####'", help="inputs as for denoise; ####, %%04d or * stands for the number")
    add("expanded", nargs="*", help=argparse.SUPPRESS)
    add("-o", "--output", metavar="'OUT/f####.exr'", required=True, help="where the results go")
    add("--frames", metavar="1-100,103", help="which frames (default: all that are there)")
    add("--cameras", metavar="'f####.json'", help="the scenes of the frames: lets one frame help the next")
    add("--refit", metavar="auto|N|0", type=_refit, default="auto", help=_REFIT_HELP)
    add("--scheduler", metavar="local|tcp://...", default="local", help="a Dask scheduler that runs already")
    add("--workers", metavar="N", type=int, help="how many local processes at most (default: 1)")
    add_fit_options(sequence, prefix="", presets=_PRESETS)
    add_file_options(sequence)
    add("--report", metavar="R.html", type=Path, help="write a page with the frames, their time and error")
    add_threads(sequence)
    add_json(sequence)


_REFIT_HELP = (
    "how many steps a frame's network is trained further: what its error asks for (auto, the default), at "
    "most N, or 0 for inference alone"
)


def _sequence(options: argparse.Namespace) -> Outcome:
    frames, run, models = _arguments(options)
    errors: list[str] = []

    def on_record(record: Record, found: Models) -> None:
        _tell(record)
        if options.save_model is not None and record.number == frames[0].number:
            # Before any other frame: a run that is interrupted leaves it, and one that resumes has another.
            try:
                _save_model(options.save_model, found, record)
            except InputError as error:
                errors.append(str(error))

    records = _denoised(options, frames, run, models, on_record)
    if options.report is not None:
        _write_report(options.report, options.input, records)
    return _summary(records, errors)


def _arguments(options: argparse.Namespace) -> tuple[list[Frame], Run, Models]:
    """Return the frames, what holds for all of them, and the networks to start from.

    Raises InputError if the options ask for what cannot be done, or for files that cannot be written.
    """
    with deferred_interrupts():
        from tungsten_dip.sequence.following import Models
        from tungsten_dip.sequence.frames import find_frames, numbers_from_text
        from tungsten_dip.sequence.work import Run

    if options.expanded:
        raise InputError(
            f"{options.expanded[0]}: expected one pattern for all frames, got {1 + len(options.expanded)} "
            f"names; quote it, so that the shell does not expand it"
        )
    if options.workers is not None:
        whole_number("--workers", options.workers, 1, MOST_THREADS)
    if options.scheduler != "local" and options.workers is not None:
        raise InputError("--workers: these are local processes, a scheduler has its own; omit one of the two")
    if options.scheduler != "local" and "://" not in options.scheduler:
        raise InputError(
            f"--scheduler {options.scheduler}: expected local or an address such as tcp://host:8786"
        )
    numbers = None if options.frames is None else numbers_from_text(options.frames)
    frames = find_frames(options.input, options.output, numbers, options.cameras)
    mapping = layer_mapping(options)
    check_outputs_are_not_inputs(
        (frame.output for frame in frames),
        set(_input_files(frames, mapping)),
        {frame.input.resolve() for frame in frames},
        mapping,
    )
    results = [(frames[0].output, ".exr"), (options.report, ".html"), (options.save_model, ".onnx")]
    for file, suffix in results:
        if file is not None:
            check_suffix(file, suffix)
    warm_start = load_warm_start(options.warm_start)
    settings = fit_settings(vars(options), (*FIT_OPTIONS, "threads"), warm_start)
    digest = None if warm_start is None else hashlib.sha256(options.warm_start.read_bytes()).hexdigest()
    run = Run(settings, options.refit, mapping, options.float16, digest)
    _make_writable(frames[0].output.parent, results)
    return frames, run, Models(alone=warm_start)


def _denoised(
    options: argparse.Namespace, frames: list[Frame], run: Run, models: Models, on_record: OnRecord
) -> list[Record]:
    """Denoise the frames, here or on workers; return their records."""
    with deferred_interrupts():
        from tungsten_dip.sequence.cluster import denoise_on_cluster
        from tungsten_dip.sequence.work import denoise_frames

    workers = options.workers or 1
    with _without_repetition(), progress_on_stderr("denoising") as progress:
        if options.scheduler == "local" and workers == 1:
            return denoise_frames(frames, run, models, progress, on_record)[0]
        return denoise_on_cluster(frames, run, options.scheduler, workers, models, progress, on_record)


def _summary(records: list[Record], errors: list[str]) -> Outcome:
    """Return what is told in the end; ``errors`` come after that of frames without a result."""
    from tungsten_dip.sequence.frames import text_from_numbers

    facts: dict[str, Any] = {"frames": [asdict(record) for record in records]}
    failures = [record.number for record in records if record.error is not None]
    if failures:
        rest = "" if len(failures) == len(records) else "; the others are done"
        listed = text_from_numbers(failures)
        errors = [f"{len(failures)} of {len(records)} frames without a result: {listed}{rest}", *errors]
    error = "; ".join(errors) or None
    if error is not None:
        facts["error"] = error
    done = [record for record in records if not record.skipped and record.error is None]
    seconds = sum(record.seconds for record in done)
    skipped = sum(record.skipped for record in records)
    before = f"; {skipped} {'was' if skipped == 1 else 'were'} finished before" if skipped else ""
    frame_or_frames = "frame" if len(done) == 1 else "frames"
    text = f"{len(done)} {frame_or_frames}, denoised in {seconds:.1f} s in all{before}"
    return Outcome(facts, text, error)


def _make_writable(folder: Path, results: Sequence[tuple[Path | None, str]]) -> None:
    """Make the folder of the frames, in which others may lie; none is left where one cannot be saved."""
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file, suffix in results:
            if file is not None:
                check_writable(file, suffix)
    except (InputError, OSError):
        for each in new:
            with suppress(OSError):  # such as that it was not made
                each.rmdir()
        raise


def _input_files(frames: Sequence[Frame], mapping: dict[str, str]) -> Iterator[Path]:
    """Yield what is read of all frames; those that cannot be read, the run itself reports."""
    for frame in frames:
        with suppress(InputError):
            yield from (file.resolve() for file in input_files(frame.input, mapping))


@contextmanager
def _without_repetition() -> Iterator[None]:
    """Keep back what was reported of an earlier frame in the same words."""
    told: set[str] = set()

    def is_new(record: logging.LogRecord) -> bool:
        if record.levelno > logging.INFO or not record.name.startswith(_TOLD_OF_EVERY_FRAME):
            return True
        words = re.sub(r"\d+", "", record.getMessage())  # numbers differ from frame to frame
        seen = words in told
        told.add(words)
        return not seen

    handlers = logging.getLogger("tungsten_dip").handlers
    for handler in handlers:
        handler.addFilter(is_new)
    try:
        yield
    finally:
        for handler in handlers:
            handler.removeFilter(is_new)


def _tell(record: Record) -> None:
    if record.skipped:
        _LOG.info("frame %d: finished already: %s", record.number, record.output)
    elif record.error is not None:
        _LOG.error("frame %d: %s", record.number, record.error)
    else:
        steps = "step" if record.iterations == 1 else "steps"
        _LOG.info(
            "frame %d: %s, %d %s, %.1f s: %s",
            record.number, record.how, record.iterations, steps, record.seconds, record.output,
        )  # fmt: skip


def _save_model(path: Path, models: Models, first: Record) -> None:
    """Save the network of the first frame, which other sequences may start from."""
    from tungsten_dip.onnx import save_model

    if first.error is not None:
        raise InputError(f"{path}: not written: frame {first.number}, whose network it is, has no result")
    if first.skipped:
        # What the first of the remaining frames left behind is another network.
        if not path.exists():
            raise InputError(
                f"{path}: not written: frame {first.number} was finished before; remove its result"
            )
        _LOG.info("%s: left as it is: frame %d was finished before", path, first.number)
        return
    if models.first is None:
        raise InputError(f"{path}: not written: no network was fitted, as frame {first.number} has no noise")
    save_model(path, models.first)


def _write_report(path: Path, title: str, records: Sequence[Record]) -> None:
    from tungsten_dip.sequence.page import sequence_page

    write_text(path, sequence_page(title, records))


def _refit(text: str) -> int | str:
    if text == "auto":
        return text
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected auto, 0 or a number of steps, got '{text}'") from None
