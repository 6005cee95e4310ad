"""Frames on many processes or machines: Dask schedules them, workers read and write the files themselves.

The first frame's networks are shared by all that begin later. Frames that follow one another are one task, so
that what one shows helps the next. A worker that dies loses the frame in hand: its task is done again
elsewhere and skips what is finished. A frame that no worker survives is given up, and the others are done.
"""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from multiprocessing import resource_tracker
from typing import Any

from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError
from tungsten_dip.extras import require
from tungsten_dip.interrupts import terminations_as_interrupts
from tungsten_dip.progress import Progress
from tungsten_dip.remarks import remarks_from_log
from tungsten_dip.sequence.following import Models, check_can_follow
from tungsten_dip.sequence.frames import Frame
from tungsten_dip.sequence.work import OnRecord, Record, Run, denoise_frames, failed, split_finished

_LOG = logging.getLogger(__name__)

_LONGEST_TASK = 24
"""Frames; a task that is done again has to look at all of them."""

_LEADS = 2
"""Frames that others wait for, where frames follow one another: the second one's network is for those that
follow."""

_CONNECT_TIMEOUT_S = 30

_LOST = (
    "the Dask scheduler that had it was lost; start one again and repeat the command, which skips finished "
    "frames"
)

_SAFE_PATH = "PYTHONSAFEPATH"

_LOCAL_WORKERS = {
    # By default glibc hands all memory back at once, and a fit, which takes it again, needs twice the time.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
    "distributed.worker.profile.enabled": False,
    # Frames are long: none waits at a worker while another worker has nothing to do.
    "distributed.scheduler.worker-saturation": 1.0,
}


def denoise_on_cluster(
    frames: Sequence[Frame],
    run: Run,
    scheduler: str,
    workers: int,
    models: Models,
    progress: Progress,
    on_record: OnRecord,
) -> list[Record]:
    """Denoise frames on the workers of a Dask scheduler, or on ``workers`` local processes at most.

    Paths mean the same to all workers (a shared file system). Without ``run.settings.threads``, local workers
    share the cores, and others use one core each. Returns the records of all frames, in their order.

    Raises InputError if Dask is not installed, the scheduler does not answer or local workers do not start.
    """
    check_can_follow(run.settings, models.alone)  # before any worker starts
    frames = [_absolute(frame) for frame in frames]
    to_do, records = split_finished(frames, run)
    for record in records:
        on_record(record, models)
    workers = min(workers, _tasks_at_once(to_do))
    if run.settings.threads is None:
        share = max(1, thread_count(None) // workers) if scheduler == "local" else 1
        run = replace(run, settings=replace(run.settings, threads=share))
    shared = models
    if to_do:
        with _client(scheduler, workers) as client, terminations_as_interrupts() as raise_if_terminated:
            for done, found, remarks in _done(client, to_do, run, models):
                shared = found or shared
                for remark in remarks:
                    _LOG.info("%s", remark)
                for record in done:
                    records.append(record)
                    on_record(record, shared)
                    progress(len(records) / len(frames), f"frame {record.number}")
                raise_if_terminated()
    return sorted(records, key=lambda record: record.number)


def _tasks_at_once(frames: list[Frame]) -> int:
    """Return how many workers can have something to do at the same time, at least 1."""
    follow = bool(frames) and frames[0].scene is not None
    return max(1, len(frames) - (_LEADS if follow else 0))


def _done(
    client: Any, frames: list[Frame], run: Run, models: Models
) -> Iterator[tuple[list[Record], Models | None, list[str]]]:
    """Yield records as they come, the first frames' with their networks, and what the worker logged."""
    from distributed import as_completed

    count = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
    group = f"frames-{os.urandom(4).hex()}"
    tasks: dict[Any, list[Frame]] = {}
    running = as_completed()

    def submit(part: list[Frame]) -> Any:
        # Tasks whose keys say that they are alike wait at the scheduler until a worker is free.
        number = len(tasks)
        task = client.submit(
            _denoise_frames, part, run, models, key=(group, number), pure=False, priority=-number
        )
        tasks[task] = part
        running.add(task)
        return task

    follow = frames[0].scene is not None
    # Where frames follow, the second one fits the network for those that follow.
    leads = _LEADS if follow else 1
    first, waiting = submit(frames[:leads]), frames[leads:]
    if not follow:
        # No frame helps another but by its network: rather than wait for one, every worker fits one.
        for frame in waiting[: count - 1]:
            submit([frame])
        waiting = waiting[count - 1 :]
    for task in running:
        records, networks, remarks, left = _outcome(task, tasks[task], run)
        yield records, networks if task is first else None, remarks
        if task is not first:
            if left:
                submit(left)
        elif networks is not None:
            models = networks
            length = max(1, min(_LONGEST_TASK, -(-len(waiting) // count))) if follow else 1
            for start in range(0, len(waiting), length):
                submit(waiting[start : start + length])
            waiting = []
        elif task.status == "error" and left + waiting:
            # The next frames lead in its place.
            waiting = left + waiting
            first, waiting = submit(waiting[:leads]), waiting[leads:]
    yield [failed(frame, InputError(_LOST)) for frame in waiting], None, []


def _outcome(
    task: Any, frames: list[Frame], run: Run
) -> tuple[list[Record], Models | None, list[str], list[Frame]]:
    """Return what `_denoise_frames` does and the frames that are still to be done.

    A task fails where its worker dies time and again: at the first of the frames that are not finished.
    """
    if task.status == "finished":
        return *task.result(), []
    to_do, records = split_finished(frames, run)
    if task.status != "error":
        return [*records, *(failed(frame, InputError(_LOST)) for frame in to_do)], None, [], []
    return [*records, *(failed(frame, task.exception()) for frame in to_do[:1])], None, [], to_do[1:]


def _denoise_frames(frames: list[Frame], run: Run, models: Models) -> tuple[list[Record], Models, list[str]]:
    """Return the records and networks of frames, and what was logged, which nobody would see on a worker."""
    with remarks_from_log() as remarks:
        return *denoise_frames(frames, run, models), remarks


@contextmanager
def _client(scheduler: str, workers: int) -> Iterator[Any]:
    require("distributed", "a run on several workers")
    import dask
    from distributed import Client, LocalCluster

    for name in ("distributed", "distributed.client"):  # which logs tracebacks; it has a level of its own
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if scheduler == "local":
        with dask.config.set(_LOCAL_WORKERS), _safe_path(), ExitStack() as stack:
            try:
                with _interrupts_blocked():
                    cluster = LocalCluster(
                        n_workers=workers,
                        threads_per_worker=1,
                        dashboard_address=None,
                        silence_logs=logging.CRITICAL,
                    )
                    client = stack.enter_context(Client(stack.enter_context(cluster)))
            except (OSError, RuntimeError) as error:
                reason = " ".join(str(error).split())
                raise InputError(
                    f"--workers {workers}: they do not start ({reason:.200}); use fewer, or allow more "
                    f"memory and open files (ulimit -n)"
                ) from error
            yield client
        return
    try:
        client = Client(scheduler, timeout=_CONNECT_TIMEOUT_S)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{scheduler}: no scheduler answers ({error}); start one with: dask scheduler"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_TIMEOUT_S)
        except TimeoutError as error:
            raise InputError(
                f"{scheduler}: the scheduler has no worker; start one with: dask worker {scheduler}"
            ) from error
        yield client


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Keep Ctrl-C back, from the processes that start meanwhile for good: it is this one that ends them."""
    # It starts with the first of them otherwise, and lets Ctrl-C through in the thread that starts them.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _safe_path() -> Iterator[None]:
    """Let processes that start meanwhile import nothing from the current folder."""
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = before


def _absolute(frame: Frame) -> Frame:
    scene = None if frame.scene is None else frame.scene.absolute()
    return replace(frame, input=frame.input.absolute(), output=frame.output.absolute(), scene=scene)
