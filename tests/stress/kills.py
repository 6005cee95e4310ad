"""Commands killed with SIGKILL at random moments: what is there is whole, and the next run succeeds."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import OpenImageIO

from commands import SCENE
from moving_camera import write_frames
from row import Row
from tungsten_dip.buffers.image_file import read_parts
from tungsten_dip.errors import InputError
from tungsten_dip.onnx import load_model

KILLS = 50
KILLS_BETWEEN_WHOLE_RUNS = 6
KILLS_BETWEEN_EMPTYING = 2


@dataclass(frozen=True)
class Command:
    """A command with what it writes, all below ``out`` in its working folder."""

    name: str
    program: str
    arguments: tuple[str, ...]
    outputs: tuple[str, ...]


COMMANDS = (
    Command(
        "render",
        "tungsten",
        (
            *("--dip-denoise", "--dip-preset", "draft", "--dip-report", "out/report.html"),
            *("--dip-save-model", "out/model.onnx", "--output-directory", "out", "scene.json"),
        ),
        (
            *("picture.png", "picture.exr", "n.exr", "nA.exr", "nB.exr", "n.png", "z.pfm"),
            *("picture_denoised.exr", "picture_denoised.png", "picture_side_by_side.png"),
            *("report.html", "model.onnx"),
        ),
    ),
    Command(
        "fit",
        "tungsten_dip",
        (
            *("denoise", "noisy/f0000", "-o", "out/image.exr", "--preset", "draft", "--threads", "1"),
            *("--report", "out/report.html", "--error-map", "out/error.exr"),
        ),
        ("image.exr", "report.html", "error.exr"),
    ),
    Command(
        "export",
        "tungsten_dip",
        (
            *("denoise", "noisy/f0000", "-o", "out/image.exr", "--preset", "paper", "--iterations", "2"),
            *("--threads", "1", "--save-model", "out/model.onnx"),
        ),
        ("image.exr", "model.onnx"),
    ),
    Command(
        "sequence",
        "tungsten_dip",
        (
            *("sequence", "noisy/f####", "-o", "out/f####.exr", "--cameras", "cameras/f####.json"),
            *("--preset", "draft", "--threads", "1", "--report", "out/report.html"),
        ),
        ("f0000.exr", "f0001.exr", "f0002.exr", "f0003.exr", "report.html"),
    ),
)


def write_inputs(folder: Path) -> None:
    """Write what the commands read."""
    write_frames(folder, 4)
    (folder / "out").mkdir()
    # Larger, lest its pictures fit on the fullest of disks.
    scene = {**SCENE, "camera": {**SCENE["camera"], "resolution": [33, 21]}}
    (folder / "scene.json").write_text(json.dumps(scene))


def start(command: Command, folder: Path, before: str = "", **options: object) -> subprocess.Popen[str]:
    """Start a command in a folder, after some statements of Python."""
    program = f"import sys; {before}\nfrom tungsten_dip.cli.{command.program} import main; sys.exit(main())"
    return subprocess.Popen(
        [sys.executable, "-c", program, *command.arguments],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        **options,  # type: ignore[call-overload]
    )


def unreadable(folder: Path) -> list[str]:
    """Return the files, but for temporary ones, that are not whole."""
    return [path.name for path in files(folder) if not _is_whole(path)]


def files(folder: Path) -> list[Path]:
    """Return the files that a user sees."""
    return [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")]


def temporary_files(folder: Path) -> list[str]:
    """Return the names of files that a kill has left."""
    return [path.name for path in sorted(folder.iterdir()) if path.name.startswith(".")]


def rows(folder: Path, kills: int = KILLS, seed: int = 0) -> list[Row]:
    """Kill every command its share of times, two commands at once."""

    def row(index: int) -> Row:
        own = folder / COMMANDS[index].name
        own.mkdir()
        count = kills // len(COMMANDS) + (index < kills % len(COMMANDS))
        return _row(COMMANDS[index], own, count, random.Random(seed + index))

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(row, range(len(COMMANDS))))


def _row(command: Command, folder: Path, kills: int, rng: random.Random) -> Row:
    write_inputs(folder)
    out = folder / "out"
    seconds, writing_seconds = _timed(command, folder)
    lost: list[str] = []
    hits = most_left = 0
    for number in range(kills):
        if number % KILLS_BETWEEN_EMPTYING == 0:
            for path in out.iterdir():
                path.unlink()
        # Every other kill hits while files are written, mostly soon after the first.
        while_writing = number % 2 == 1
        delay = writing_seconds * rng.random() ** 4 if while_writing else 0.9 * seconds * rng.random()
        hits += _killed(command, folder, delay, while_writing)
        most_left = max(most_left, len(temporary_files(out)))
        lost += [f"{name} is not whole after kill {number}" for name in unreadable(out)]
        if (number + 1) % KILLS_BETWEEN_WHOLE_RUNS == 0 or number + 1 == kills:
            lost += _lost_in_next_run(command, folder)
    note = f"{hits} hit a living process; up to {most_left} hidden files left, none after the next run"
    return Row(f"kill -9 of {command.name}", kills, kills - len(lost), tuple(lost), note)


def _timed(command: Command, folder: Path) -> tuple[float, float]:
    """Return how many seconds a whole run takes, and how many of these from its first file on."""
    started = time.perf_counter()
    process = start(command, folder)
    _wait_for_writing(process, folder)
    first_file = time.perf_counter()
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    ended = time.perf_counter()
    return ended - started, ended - first_file


def _killed(command: Command, folder: Path, delay: float, while_writing: bool) -> bool:
    """Kill a run after a delay; return whether it was still alive."""
    process = start(command, folder)
    try:
        if while_writing:
            _wait_for_writing(process, folder)
        time.sleep(delay)
        alive = process.poll() is None
    finally:
        process.kill()
        process.communicate()
    return alive


def _wait_for_writing(process: subprocess.Popen[str], folder: Path) -> None:
    """Wait until the first change in the folder of outputs, or the end of the process."""
    before = _state(folder / "out")
    while process.poll() is None and _state(folder / "out") == before:
        time.sleep(0.0005)


def _state(folder: Path) -> set[tuple[str, int]]:
    with os.scandir(folder) as entries:
        return {(entry.name, entry.inode()) for entry in entries}


def _lost_in_next_run(command: Command, folder: Path) -> list[str]:
    """Run the command to its end; return what went wrong."""
    out = folder / "out"
    finished = {p: p.read_bytes() for p in files(out)} if command.name == "sequence" else {}
    finished.pop(out / "report.html", None)
    process = start(command, folder)
    _, errors = process.communicate()
    if process.returncode != 0:
        return [f"the next run ended with status {process.returncode}: {errors.splitlines()[-1:]}"]
    lost = [f"{name} is missing after the next run" for name in command.outputs if not (out / name).exists()]
    lost += [f"{name} is not whole after the next run" for name in unreadable(out)]
    lost += [f"{name} is left after the next run" for name in temporary_files(out)]
    lost += [
        f"{path.name} was done again" for path, content in finished.items() if path.read_bytes() != content
    ]
    return lost


def _is_whole(path: Path) -> bool:
    if path.suffix == ".exr":
        try:
            return bool(read_parts(path))
        except InputError:
            return False
    if path.suffix == ".onnx":
        try:
            return bool(load_model(path).weights)
        except InputError:
            return False
    if path.suffix == ".html":
        return path.read_text().rstrip().endswith("</html>")
    image = OpenImageIO.ImageBuf(str(path))
    return bool(image.read()) and not image.has_error
