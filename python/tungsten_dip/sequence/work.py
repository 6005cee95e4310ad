"""The files of a run: frames are read, denoised in their order, and written whole, each when it is done.

A frame's file says what it was made from and how. A run that comes later (after a kill, say) skips it, unless
its input or the settings have changed since.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata
from typing import Any, Literal

from tungsten_dip.buffers.image_file import is_whole, read_attributes
from tungsten_dip.buffers.read import input_files, read_buffers
from tungsten_dip.errors import InputError, whole_number
from tungsten_dip.failures import line_of_failure
from tungsten_dip.fit.settings import MOST_ITERATIONS, FitSettings
from tungsten_dip.fit.write import write_denoised
from tungsten_dip.progress import Progress, part_of, silent
from tungsten_dip.scene.parse import load_camera
from tungsten_dip.sequence.following import Follower, How, Models, Refit
from tungsten_dip.sequence.frames import RECORD, Frame

_LOG = logging.getLogger(__name__)

_NOT_OF_THE_IMAGE = ("threads", "device")
"""Settings that may differ between the runs of one sequence."""


@dataclass(frozen=True)
class Run:
    """What holds for all frames of a run.

    ``float16`` stores pictures as 16-bit floats. ``warm_start_sha256`` is that of the file of the model that
    the first frame starts from, if any.

    Raises InputError if ``refit`` cannot be done.
    """

    settings: FitSettings = field(default_factory=FitSettings)
    refit: Refit = "auto"
    mapping: dict[str, str] = field(default_factory=dict)
    float16: bool = False
    warm_start_sha256: str | None = None

    def __post_init__(self) -> None:
        if self.refit != "auto":
            steps = whole_number("refit, unless auto", self.refit, 0, MOST_ITERATIONS)
            object.__setattr__(self, "refit", steps)


@dataclass(frozen=True)
class Record:
    """What became of a frame. ``how`` is as in `following.Followed`, empty without a result.

    ``error`` says why there is none. ``seconds`` is all that the frame took but for writing it. ``flicker``
    is that against the frame right before, where the run denoised it. ``skipped``: it was finished before.
    """

    number: int
    output: str
    how: Literal[How, ""] = ""
    seconds: float = 0.0
    iterations: int = 0
    estimated_relmse: float | None = None
    flicker: float | None = None
    error: str | None = None
    skipped: bool = False


def finished(frame: Frame, run: Run) -> Record | None:
    """Return the record of a frame whose file is there and up to date, None if it is to be done.

    Raises InputError if the input is missing.
    """
    key = _key(frame, run)
    if not frame.output.is_file():
        return None
    try:
        stored = json.loads(read_attributes(frame.output)[RECORD])
        if stored.pop("key") != key or not is_whole(frame.output):
            return None
        return Record(**{**stored, "number": frame.number, "output": str(frame.output), "skipped": True})
    except (AttributeError, InputError, KeyError, RecursionError, TypeError, ValueError):
        return None


def split_finished(frames: Iterable[Frame], run: Run) -> tuple[list[Frame], list[Record]]:
    """Return the frames that are to be done, and the records of the others."""
    to_do, records = [], []
    for frame in frames:
        try:
            record = finished(frame, run)
        except Exception as error:
            record = failed(frame, error)
        if record is None:
            to_do.append(frame)
        else:
            records.append(record)
    return to_do, records


OnRecord = Callable[[Record, Models], None]
"""Gets the record of a frame, and the networks that are known by then."""


def denoise_frames(
    frames: Iterable[Frame],
    run: Run,
    models: Models = Models(),
    progress: Progress = silent,
    on_record: OnRecord = lambda *_: None,
) -> tuple[list[Record], Models]:
    """Denoise frames one after another; return their records and the networks in the end.

    Frames that are finished are skipped; one that cannot be done, for whatever reason, has an error in its
    record, and the others are done. Ctrl-C ends the run between two frames at the latest; a frame cut short
    is not saved. ``on_record`` gets every record as soon as it is known, and the networks of then.
    """
    follower = Follower(run.settings, run.refit, models)
    frames = list(frames)
    records: list[Record] = []
    latest: int | None = None  # the frame that was denoised last
    for index, frame in enumerate(frames):
        start, end = index / len(frames), (index + 1) / len(frames)
        part = part_of(progress, start, end, f"frame {frame.number}")
        is_consecutive = latest is not None and latest == frame.previous
        try:
            record = finished(frame, run) or _denoise(frame, run, follower, is_consecutive, part)
        except Exception as error:
            record = failed(frame, error)
        if record.error is None and not record.skipped:
            latest = record.number
        records.append(record)
        on_record(record, follower.models)
    return records, follower.models


def _denoise(frame: Frame, run: Run, follower: Follower, is_consecutive: bool, progress: Progress) -> Record:
    """Denoise and write a frame; ``is_consecutive``: whether the follower's last one is right before it."""
    started = time.perf_counter()
    key = _key(frame, run)
    buffers = read_buffers(frame.input, run.mapping)
    camera = None if frame.scene is None else load_camera(frame.scene)
    followed = follower.denoise(buffers, camera, progress)
    result = followed.result
    if result.interrupted:
        # The fit has ended early, which is no reason for a sequence to go on with a worse frame.
        raise KeyboardInterrupt
    record = Record(
        number=frame.number,
        output=str(frame.output),
        how=followed.how,
        seconds=time.perf_counter() - started,
        iterations=result.iterations,
        estimated_relmse=result.estimated_relmse,
        flicker=followed.flicker if is_consecutive else None,
    )
    attributes = {**buffers.attributes, RECORD: json.dumps({"key": key, **asdict(record)})}
    frame.output.parent.mkdir(parents=True, exist_ok=True)
    write_denoised(frame.output, result, replace(buffers, attributes=attributes), float16=run.float16)
    return record


def failed(frame: Frame, error: BaseException) -> Record:
    """Return the record of a frame that has no result; the traceback is logged for whoever looks for it."""
    _LOG.debug("frame %d failed", frame.number, exc_info=error)
    message, _ = line_of_failure(error)
    if frame.output.is_file():
        message += f"; {frame.output} is an earlier result"
    return Record(frame.number, str(frame.output), error=message)


def _key(frame: Frame, run: Run) -> str:
    """Return what shows whether a result is of this input, these settings and this version.

    Raises InputError if the input is missing.
    """
    files = input_files(frame.input, run.mapping)
    if frame.scene is not None:
        files.append(frame.scene)
    try:
        # By their paths: files of two takes may be alike in all else. One that has moved may be another one.
        stats = [(file.stat().st_size, file.stat().st_mtime_ns, str(file.absolute())) for file in files]
    except OSError as error:
        raise InputError(f"{error.filename}: no such file; mend the pattern") from error
    settings = {k: v for k, v in asdict(run.settings).items() if k not in _NOT_OF_THE_IMAGE}
    asked = (settings, run.refit, run.mapping, run.float16, run.warm_start_sha256)
    facts: list[Any] = [stats, *asked, metadata.version("tungsten-dip")]
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
