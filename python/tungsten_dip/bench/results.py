"""Measurements in a CSV file that grows row by row, so that an interrupted run can be resumed."""

from __future__ import annotations

import csv
import fcntl
import os
import statistics
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from tungsten_dip.buffers.atomic import replacing
from tungsten_dip.errors import InputError, whole_number
from tungsten_dip.report.metrics import Comparison


@dataclass(frozen=True)
class Key:
    """What was measured: measurements with equal keys are of the same thing.

    ``settings`` are those that are not the default, ``version`` that of the package, ``input`` the digest of
    the set.
    """

    set: str
    method: str
    settings: str
    version: str
    input: str
    machine: str
    repeat: int


@dataclass(frozen=True, kw_only=True)
class Measurement(Comparison):
    """One row: the key, its cost and its error against the reference.

    ``seconds`` is None for a saved image whose time is unknown. ``loss`` and ``psnr_noisy``
    are those of the published method's iteration.
    """

    key: Key
    seconds: float | None
    iterations: int | None
    loss: float | None = None
    psnr_noisy: float | None = None


VALUES = tuple(field.name for field in fields(Measurement) if field.name != "key")
COLUMNS = (*(field.name for field in fields(Key)), *VALUES)
_INTEGERS = ("repeat", "iterations", "nonfinite")
_LARGEST = (1 << 63) - 1


class Results:
    """The measurements of a file. What `add` has returned from is on disk, whole."""

    def __init__(self, path: Path) -> None:
        """Read what the file holds; it need not exist.

        Raises InputError if it exists and is no file of measurements.
        """
        self._path = path
        self._by_key: dict[Key, Measurement] = {}
        self._add_those_of_the_file()

    def __contains__(self, key: Key) -> bool:
        return key in self._by_key

    def add(self, measurements: Iterable[Measurement]) -> None:
        """Add rows and rewrite the file, whole or not at all, with the rows that others have added."""
        added = {row.key: row for row in measurements}
        with _locked(self._path.parent):
            self._add_those_of_the_file()
            self._by_key |= added
            self._write()

    def _add_those_of_the_file(self) -> None:
        if self._path.exists():
            self._by_key |= {row.key: row for row in _read(self._path)}

    def _write(self) -> None:
        with replacing(self._path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
            writer.writeheader()
            for row in self._by_key.values():
                values = asdict(row)
                writer.writerow({**values.pop("key"), **values})

    def medians(self, key: Key, repeats: int) -> Measurement:
        """Return the medians of every value over the repeats 0, 1, ... of a key that have been measured."""
        keys = [replace(key, repeat=index) for index in range(repeats)]
        rows = [self._by_key[each] for each in keys if each in self._by_key]
        return Measurement(
            key=keys[0], **{name: _median([getattr(row, name) for row in rows]) for name in VALUES}
        )


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Let one process at a time change a folder's measurements."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # of a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _median(values: Sequence[Any]) -> Any:
    known = [value for value in values if value is not None]
    if not known:
        return None
    median = statistics.median(known)
    return int(median) if isinstance(known[0], int) else median


def _read(path: Path) -> list[Measurement]:
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            reader = csv.DictReader(stream)
            if set(reader.fieldnames or ()) != set(COLUMNS):
                raise ValueError("its columns are others")
            return [_measurement(row) for row in reader]
    except (ValueError, TypeError, csv.Error) as error:
        raise InputError(
            f"{path}: expected measurements that an earlier run wrote, but {error}; choose another folder"
        ) from error


def _measurement(row: dict[str, str]) -> Measurement:
    values: dict[str, Any] = {}
    for name, text in row.items():
        if name in VALUES or name == "repeat":
            values[name] = None if text == "" else _number(name, text)
        else:
            values[name] = text
    key = Key(**{field.name: values.pop(field.name) for field in fields(Key)})
    return Measurement(key=key, **values)


def _number(name: str, text: str) -> float:
    # Larger whole numbers have no median, which is a float.
    return whole_number(name, int(text), 0, _LARGEST) if name in _INTEGERS else float(text)
