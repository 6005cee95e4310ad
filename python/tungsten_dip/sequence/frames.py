"""Which files are frames: ``f####``, ``f%04d`` and ``f*``, and the numbers among them that are asked for."""

from __future__ import annotations

import glob
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from tungsten_dip.buffers.image_file import read_attributes
from tungsten_dip.buffers.source import OWN
from tungsten_dip.errors import InputError

RECORD = OWN + "frame"
"""The attribute of a frame's file that holds its record."""

_NUMBER = re.compile(r"##+|%0?(\d+)d")
_ONE_SIGN = re.compile(r"(?:#|%(\d*)d)(?=[^/]*/*$)")
"""Counts only in the last name of a path, where nothing longer does: folders may be called ``take#2``."""

_MOST_FRAMES = 1_000_000
"""Frames in one range of numbers: they are all held in memory, and more than that is a slip."""


@dataclass(frozen=True)
class Frame:
    """One frame: its number, what it is read from and where its result goes, and the scene of its camera.

    ``previous`` is the number of the frame right before it, None for the first one and after a gap.
    """

    number: int
    input: Path
    output: Path
    scene: Path | None = None
    previous: int | None = None


def numbers_from_text(text: str) -> tuple[int, ...]:
    """Return the numbers of ``1-100`` or ``1-3,7,10-12``, in order, each once.

    Raises InputError if the text is anything else.
    """
    numbers: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9}))?", part.strip())
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if first > last or last - first >= _MOST_FRAMES:
            raise InputError(f"frames {text}: expected numbers such as 1-100 or 1-3,7; mend '{part}'")
        numbers.update(range(first, last + 1))
    return tuple(sorted(numbers))


def text_from_numbers(numbers: Iterable[int]) -> str:
    """Return numbers in their order as ``1-3, 7``, which `numbers_from_text` reads."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1][1:] = [number]
        else:
            runs.append([number])
    return ", ".join("-".join(map(str, run)) for run in runs)


def find_frames(
    inputs: str, outputs: str, numbers: tuple[int, ...] | None = None, scenes: str | None = None
) -> list[Frame]:
    """Return the frames in the order of their numbers.

    ``inputs`` has a place for the number (``####``, ``%04d``; ``#`` and ``%d`` in the last name of the path
    alone) or is a glob pattern, whose files are numbered by the last digits of their names; results of a
    sequence that it matches as well, where ``outputs`` puts them, are left out. ``outputs`` has a place for
    the number, and so has ``scenes``, unless the camera stands still. Of ``numbers``, every one is a frame,
    whether its files exist or not; None means what is there. They are a step apart, that of the two closest
    ones: of 1, 3, 5, 9 one is missing.

    Raises InputError if a pattern has no place for a number, or nothing matches it.
    """
    if not _places(outputs).search(outputs):
        raise InputError(f"{outputs}: expected a place for the frame's number, such as out/f####.exr")
    if _places(inputs).search(inputs):
        present = {number: Path(_named(inputs, number)) for number in numbers or ()}
        if numbers is None:
            present = _numbered(inputs)
    else:
        present = _globbed(inputs, outputs)
        if numbers is not None:
            missing = Path(inputs)
            present = {number: present.get(number, missing) for number in numbers}
    if not present:
        raise InputError(f"{inputs}: no such frames; check the pattern (quoted, so that the shell keeps it)")
    frames = []
    step = min((after - before for before, after in pairwise(sorted(present))), default=1)
    for number, path in sorted(present.items()):
        scene = None if scenes is None else Path(_named(scenes, number))
        previous = number - step if number - step in present else None
        frames.append(Frame(number, path, Path(_named(outputs, number)), scene, previous))
    return frames


def _places(pattern: str) -> re.Pattern[str]:
    return _NUMBER if _NUMBER.search(pattern) else _ONE_SIGN


def _named(pattern: str, number: int) -> str:
    return _places(pattern).sub(lambda match: f"{number:0{_digits(match)}d}", pattern)


def _digits(match: re.Match[str]) -> int:
    return int(match[1] or 1) if match[0].startswith("%") else len(match[0])


def _numbered(pattern: str) -> dict[int, Path]:
    """Return the existing files whose name is the pattern's for some number."""
    pattern = str(Path(pattern))
    places = _places(pattern)
    between = [re.escape(text) for text in _between(places, pattern)]
    digits = re.compile(r"(\d+)".join(between))
    found = {}
    for path in _glob("*".join(glob.escape(text) for text in _between(places, pattern))):
        match = digits.fullmatch(str(path))
        if match and _named(pattern, number := int(match[1])) == str(path):
            found[number] = path
    return found


def _between(places: re.Pattern[str], pattern: str) -> list[str]:
    """Return what stands before, between and after the places for a number."""
    ends = [0, *(end for match in places.finditer(pattern) for end in match.span()), len(pattern)]
    return [pattern[first:end] for first, end in zip(ends[::2], ends[1::2], strict=True)]


def _globbed(pattern: str, outputs: str) -> dict[int, Path]:
    if not glob.has_magic(pattern):
        raise InputError(
            f"{pattern}: expected a place for the frame's number, such as f####, f%04d or f*; or use denoise"
        )
    outputs_there = {path.resolve() for path in _numbered(outputs).values()}
    found: dict[int, Path] = {}
    for path in _glob(pattern):
        if path.resolve() in outputs_there and _is_result(path):
            continue
        digits = re.findall(r"\d+", path.stem if path.is_file() else path.name)
        if not digits:
            raise InputError(f"{path}: expected a frame's number in its name; use a narrower pattern")
        number = int(digits[-1])
        if number in found:
            raise InputError(f"{found[number]} and {path}: both are frame {number}; use a narrower pattern")
        found[number] = path
    return found


def _is_result(path: Path) -> bool:
    try:
        return RECORD in read_attributes(path)
    except InputError:  # any other file that is named like a result
        return False


def _glob(pattern: str) -> list[Path]:
    """Return what a pattern matches: as in a shell, hidden files only if its last name begins with a dot."""
    path = Path(pattern)
    hidden = path.name.startswith(".")
    try:
        found = sorted(Path(path.anchor).glob(str(path.relative_to(path.anchor))))
        return [match for match in found if hidden or not match.name.startswith(".")]
    except ValueError as error:  # of ** beside other signs, in Python 3.11 and 3.12
        raise InputError(f"{pattern}: is no pattern for files ({error}); use f####, f%04d or f*") from error
