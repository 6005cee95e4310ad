"""Files that lie, full disks, folders, memory and clocks that do not play along: one line, status 2."""

from __future__ import annotations

import io
import json
import os
import resource
import stat
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

from kills import COMMANDS, Command, files, start, temporary_files, unreadable, write_inputs
from row import Row
from synthetic import synthetic_render
from tungsten_dip.buffers.write import write_tungsten_folder
from tungsten_dip.cli import tungsten, tungsten_dip

DISK_BYTES = (1 << 12, 1 << 14, 40 << 10)
"""How much of a file fits."""

MEMORY_MIB = (250, 400, 450, 500, 550, 600, 650, 700, 800, 1000, 4000)
"""From too little to load the libraries, over too little for the pilots and for the network, to enough."""

JUMPING_CLOCK = (
    "import random, time; real = time.time; time.time = lambda: real() + random.uniform(-1e9, 1e9); "
)


def rows(folder: Path) -> list[Row]:
    """Try all of it."""
    parts = (_full_disk, _small_disk, _read_only_folder, _memory, _clock, _old_files, _scenes)
    found = []
    for part in parts:
        own = folder / part.__name__
        own.mkdir()
        found.append(part(own))
    return found


def _full_disk(folder: Path) -> Row:
    """No file may grow beyond some bytes."""
    tried, lost = 0, []
    for command in COMMANDS:
        own = folder / command.name
        own.mkdir()
        write_inputs(own)
        for size in DISK_BYTES:
            tried += 1
            process = start(
                command, own, preexec_fn=lambda n=size: resource.setrlimit(resource.RLIMIT_FSIZE, (n, n))
            )
            lost += _refusal(process, command, own / "out", f"{command.name}, files of {size} bytes")
    return Row("disk full: no file larger than 4, 16, 40 KiB", tried, tried - len(lost), tuple(lost))


def _small_disk(folder: Path) -> Row:
    """A file system of 64 KiB, where this process may mount one."""
    with _mounted(folder, "size=64k") as mounted:
        if not mounted:
            return Row(
                "disk full: a file system of 64 KiB", 0, 0, note="not tried: mounting is not permitted"
            )
        lost = []
        for command in COMMANDS:
            own = Path(tempfile.mkdtemp())
            write_inputs(own)
            (own / "out").rmdir()
            (own / "out").symlink_to(folder)
            (folder / ".ballast").write_bytes(bytes(40 << 10))
            lost += _refusal(start(command, own), command, folder, command.name)
        return Row(
            "disk full: a file system of 64 KiB", len(COMMANDS), len(COMMANDS) - len(lost), tuple(lost)
        )


def _read_only_folder(folder: Path) -> Row:
    """Root may write anywhere but on a read-only file system."""
    what = "read-only folder"
    write_inputs(folder)
    out = folder / "out"
    with _mounted(out, "ro") as mounted:
        if not mounted:
            if os.geteuid() == 0:
                return Row(what, 0, 0, note="not tried: root may write, and mounting is not permitted")
            out.chmod(stat.S_IRUSR | stat.S_IXUSR)
        lost = [
            line
            for command in COMMANDS
            for line in _refusal(start(command, folder), command, out, command.name)
        ]
        if not mounted:
            out.chmod(stat.S_IRWXU)
    return Row(what, len(COMMANDS), len(COMMANDS) - len(lost), tuple(lost))


def _memory(folder: Path) -> Row:
    """Address space of some MiB, for an image that needs many."""
    (folder / "out").mkdir()
    write_tungsten_folder(folder / "noisy", synthetic_render(600, 900, 4).buffers)
    arguments = ("denoise", "noisy", "-o", "out/image.exr", "--preset", "draft", "--time-budget", "1")
    command = Command("fit", "tungsten_dip", arguments, ("image.exr",))
    lost, succeeded = [], 0
    for mib in MEMORY_MIB:
        size = mib << 20
        process = start(
            command, folder, preexec_fn=lambda n=size: resource.setrlimit(resource.RLIMIT_AS, (n, n))
        )
        _, errors = process.communicate()
        if process.returncode == 0:
            succeeded += 1
        elif "thread-local data" in errors:
            pass  # The loader of libraries ends a process whose new thread finds no memory, in its own words.
        elif process.returncode != 2 or "Traceback" in errors:
            lost.append(f"{mib} MiB: status {process.returncode}: {errors.splitlines()[-1:]}")
        lost += [f"{mib} MiB: {name} is not whole" for name in unreadable(folder / "out")]
    if succeeded == 0:
        lost.append("even 4 GiB were not enough")
    note = f"{succeeded} had enough"
    return Row(
        "memory limited to 0.25 to 4 GiB", len(MEMORY_MIB), len(MEMORY_MIB) - len(lost), tuple(lost), note
    )


def _clock(folder: Path) -> Row:
    """A clock that jumps by up to 30 years at every look."""
    lost = []
    for command in COMMANDS:
        own = folder / command.name
        own.mkdir()
        write_inputs(own)
        process = start(command, own, before=JUMPING_CLOCK)
        _, errors = process.communicate()
        if process.returncode != 0:
            lost.append(f"{command.name}: status {process.returncode}: {errors.splitlines()[-1:]}")
        lost += [f"{command.name}: {name} is not whole" for name in unreadable(own / "out")]
    return Row("a clock that jumps", len(COMMANDS), len(COMMANDS) - len(lost), tuple(lost))


def _old_files(folder: Path) -> Row:
    """Inputs of 1902 and of 2100: finished frames are still known, changed ones are done again."""
    command = next(command for command in COMMANDS if command.name == "sequence")
    write_inputs(folder)
    lost = []
    dates = {"1902": -2_145_916_800, "2100": 4_102_444_800}
    for year, seconds in dates.items():
        for path in (folder / "noisy" / "f0001").iterdir():
            os.utime(path, (seconds, seconds))
        contents = []
        for _ in range(2):
            process = start(command, folder)
            _, errors = process.communicate()
            if process.returncode != 0:
                lost.append(f"{year}: status {process.returncode}: {errors.splitlines()[-1:]}")
            contents.append({p.name: p.read_bytes() for p in files(folder / "out") if p.suffix == ".exr"})
        if contents[0] != contents[1]:
            lost.append(f"{year}: finished frames were done again")
    return Row("inputs dated 1902 and 2100", len(dates), len(dates) - len(lost), tuple(lost))


def _refusal(process: subprocess.Popen[str], command: Command, out: Path, what: str) -> list[str]:
    """Return what was wrong about how a command that cannot write ended."""
    _, errors = process.communicate()
    wrong = []
    last = (errors.splitlines() or ["nothing on stderr"])[-1]
    if process.returncode != 2 or "Traceback" in errors or "internal error" in errors:
        wrong.append(f"status {process.returncode}: {last}")
    wrong += [f"{name} is not whole" for name in unreadable(out)]
    wrong += [f"{name} is left" for name in temporary_files(out) if name != ".ballast"]
    for path in files(out):
        path.unlink()
    return [f"{what}: {'; '.join(wrong)}"] if wrong else []


@contextmanager
def _mounted(folder: Path, options: str) -> Iterator[bool]:
    """Mount an empty file system in memory, if that is permitted; yield whether it is there."""
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", folder], capture_output=True)
    try:
        yield done.returncode == 0
    finally:
        if done.returncode == 0:
            subprocess.run(["umount", folder], check=True)


# --- scenes and other files


def _scenes(folder: Path) -> Row:
    """Scenes and models that nobody would write by mistake."""
    camera = {"type": "pinhole", "resolution": [16, 9]}
    scenes: dict[str, str] = {
        "lists a million deep": "[" * 1_000_000,
        "objects a million deep": '{"camera":' * 1_000_000,
        "a million deep, closed": '{"camera": ' + "[" * 1_000_000 + "]" * 1_000_000 + "}",
        "resolution NaN": '{"camera": {"type": "pinhole", "resolution": [NaN, 16]}}',
        "resolution infinite": '{"camera": {"type": "pinhole", "resolution": [Infinity, 16]}}',
        "resolution 1e400": '{"camera": {"type": "pinhole", "resolution": [1e400, 16]}}',
        "1e9 x 1e9 pixels": json.dumps({"camera": {**camera, "resolution": [10**9, 10**9]}}),
        "-1 x 5 pixels": json.dumps({"camera": {**camera, "resolution": [-1, 5]}}),
        "a number of a million digits": '{"camera": {"type": "pinhole", "fov": ' + "9" * 1_000_000 + "}}",
        "a mesh out of the folder": json.dumps(
            {"camera": camera, "primitives": [{"type": "mesh", "file": "../../../../etc/passwd"}]}
        ),
        "a mesh that is a device": json.dumps(
            {"camera": camera, "primitives": [{"type": "mesh", "file": "/dev/zero"}]}
        ),
        "a texture out of the folder": json.dumps(
            {
                "camera": camera,
                "bsdfs": [{"name": "b", "type": "lambert", "albedo": "../../../../etc/passwd"}],
                "primitives": [{"type": "quad", "bsdf": "b"}],
            }
        ),
        "an output out of the folder": json.dumps(
            {"camera": camera, "renderer": {"output_file": "../../../../proc/1/mem.png", "spp": 1}}
        ),
        "instances of themselves": json.dumps(
            {
                "camera": camera,
                "primitives": [
                    {"type": "instances", "name": "i", "masters": ["i"], "instances": []},
                ],
            }
        ),
        "BSDFs of themselves": json.dumps(
            {
                "camera": camera,
                "bsdfs": [{"name": "a", "type": "mixed", "bsdf0": "a", "bsdf1": "a", "ratio": 0.5}],
                "primitives": [{"type": "quad", "bsdf": "a"}],
            }
        ),
        "instances a billion times": json.dumps(
            {
                "camera": camera,
                "primitives": [
                    {"type": "quad", "name": "q"},
                    {"type": "instances", "masters": ["q"], "instances": "../../../../dev/zero"},
                ],
            }
        ),
        "zeros": "\0" * 1000,
        "empty": "",
    }
    lost = []
    paths: dict[str, Path] = {"/dev/zero": Path("/dev/zero"), "/dev/full": Path("/dev/full")}
    for name, text in scenes.items():
        paths[name] = folder / f"{len(paths)}.json"
        paths[name].write_text(text)
    for name, path in paths.items():
        for what, run in (
            ("tungsten", lambda p=path: tungsten.main(["--output-directory", str(folder / "out"), str(p)])),
            ("inspect", lambda p=path: tungsten_dip.main(["inspect", str(p)])),
        ):
            wrong = _not_refused(run, must_fail=what == "tungsten")
            if wrong:
                lost.append(f"{name}, {what}: {wrong}")
    tried = 2 * len(paths)
    return Row("scenes that lie", tried, tried - len(lost), tuple(lost))


def _not_refused(run: Callable[[], int], must_fail: bool) -> str | None:
    """Return what was wrong about how a command refused a file."""
    with redirect_stderr(io.StringIO()) as errors, redirect_stdout(io.StringIO()):
        status = run()
    text = errors.getvalue()
    last = (text.splitlines() or [""])[-1]
    if status not in ((2,) if must_fail else (0, 2)) or "Traceback" in text or "internal error" in text:
        return f"status {status}: {last[:200]}"
    return None if len(last) < 1000 else "a line of more than 1000 characters"
