"""Many fits and many frames in one process: memory and file descriptors stay as they are."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from moving_camera import write_frames
from row import Row
from synthetic import synthetic_render
from tungsten_dip.fit import FitSettings, denoise
from tungsten_dip.sequence.frames import find_frames
from tungsten_dip.sequence.work import Run, denoise_frames

FITS = 100
FRAMES = 200
WARM_UP = 0.3
"""Part of the work after which memory must grow no more."""

MOST_GROWTH_MIB = 16

SETTINGS = FitSettings(preset="draft", iterations=10, threads=1, device="cpu")


def rows(folder: Path) -> list[Row]:
    """Watch fits and a sequence."""
    return [_fits(), _sequence(folder)]


class _Watch:
    """What the process holds, noted again and again."""

    def __init__(self) -> None:
        self._mib: list[float] = []
        self._descriptors: list[int] = []

    def note(self) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self._mib.append(pages * os.sysconf("SC_PAGE_SIZE") / (1 << 20))
        self._descriptors.append(len(list(Path("/proc/self/fd").iterdir())))

    def row(self, what: str) -> Row:
        warm = int(WARM_UP * len(self._mib))
        grown = max(self._mib[warm:]) - max(self._mib[: warm + 1])
        opened = self._descriptors[-1] - self._descriptors[warm]
        lost = []
        if grown > MOST_GROWTH_MIB:
            lost.append(f"memory grew by {grown:.0f} MiB")
        if opened:
            lost.append(f"{opened} file descriptors were left open")
        note = f"{grown:+.1f} MiB after the first {WARM_UP:.0%}, {opened:+d} file descriptors"
        count = len(self._mib)
        return Row(what, count, count if not lost else 0, tuple(lost), note)


def _fits() -> Row:
    buffers = synthetic_render(24, 32, 4).buffers
    watch = _Watch()
    for _ in range(FITS):
        denoise(buffers, SETTINGS)
        watch.note()
    return watch.row(f"{FITS} fits in one process")


def _sequence(folder: Path) -> Row:
    write_frames(folder, FRAMES, spp=4)
    frames = find_frames(
        str(folder / "noisy" / "f####"),
        str(folder / "out" / "f####.exr"),
        None,
        str(folder / "cameras" / "f####.json"),
    )
    watch = _Watch()
    tell: Callable[[object], None] = lambda record: watch.note()  # noqa: E731
    records, _ = denoise_frames(frames, Run(SETTINGS), on_record=tell)
    row = watch.row(f"a sequence of {FRAMES} frames")
    failed = [f"frame {record.number}: {record.error}" for record in records if record.error]
    return Row(row.what, row.tried, row.held - len(failed), (*row.lost, *failed), row.note)
