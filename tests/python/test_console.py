"""What both commands share: exit statuses, durations, interrupts, terminals."""

import argparse
import io
import logging
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from commands import MAIN
from tungsten_dip.buffers.image_file import write_exr, write_image
from tungsten_dip.buffers.read import read_image
from tungsten_dip.buffers.source import Part
from tungsten_dip.cli import console, entry
from tungsten_dip.cli import tungsten_dip as command
from tungsten_dip.cli.console import duration, minutes, progress_on_stderr
from tungsten_dip.interrupts import deferred_interrupts


def test_the_package_runs_as_the_command():
    program = [sys.executable, "-m", "tungsten_dip", "inspect", "nowhere.json"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("tungsten-dip: nowhere.json")


def test_an_internal_error_is_one_line_and_a_traceback_only_on_demand(folder, tmp_path, monkeypatch, capfd):
    def broken(buffers, settings, progress, warm_start):
        raise RuntimeError("a bug\nin two lines")

    monkeypatch.setattr("tungsten_dip.cli.denoising.denoise", broken)
    arguments = ["denoise", str(folder), "-o", str(tmp_path / "out.exr")]
    assert command.main(arguments) == 1
    last = capfd.readouterr().err.splitlines()[-1]
    assert last.startswith("tungsten-dip: internal error: RuntimeError: a bug in two lines")
    monkeypatch.setenv("TUNGSTEN_DIP_DEBUG", "1")
    with pytest.raises(RuntimeError, match="a bug"):
        command.main(arguments)


def test_a_command_leaves_logging_and_stdout_as_they_were(folder, tmp_path, fits, capfd):
    logger = logging.getLogger("tungsten_dip")
    before = (list(logger.handlers), logger.level, logger.propagate)
    assert command.main(["denoise", str(folder), "-o", str(tmp_path / "out.exr"), "--json"]) == 0
    assert (list(logger.handlers), logger.level, logger.propagate) == before
    capfd.readouterr()
    os.write(1, b"still there")
    assert capfd.readouterr().out == "still there"


def test_a_reader_that_stops_early_is_no_error(scene):
    command = shlex.join([sys.executable, "-c", MAIN.format("tungsten_dip"), "inspect", str(scene)])
    script = f"{command} | head -c 1"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert len(done.stdout) == 1
    assert "rror" not in done.stderr


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90s", 90), ("5m", 300), ("1.5h", 5400), ("1h30m", 5400), ("250ms", 0.25), ("2 m", 120), ("45", 45)],
)
def test_durations(text, seconds):
    assert duration(text) == pytest.approx(seconds)


def test_a_bare_number_means_minutes_to_tungsten():
    assert minutes("2") == 120
    assert minutes("2s") == 2


@pytest.mark.parametrize("text", ["", "soon", "-5s", "5x", "5s later", "s", "1e3", "nan"])
def test_texts_that_are_no_duration(text):
    with pytest.raises(Exception, match="expected a duration"):
        duration(text)


@pytest.mark.parametrize(
    "text", ["9" * 20_000 + "x", "1." + "9" * 20_000 + "x", "1s" * 20_000 + "x", "9" * 400]
)
def test_a_long_text_that_is_no_duration_is_refused_in_one_short_line(text):
    with pytest.raises(argparse.ArgumentTypeError, match="expected a duration") as refused:
        duration(text)
    assert len(str(refused.value)) < 200


def test_durations_that_add_up_to_more_than_any_number_are_refused():
    with pytest.raises(argparse.ArgumentTypeError, match="expected a duration"):
        duration(("1" + "0" * 308 + "s") * 2)


@pytest.mark.parametrize("redirection", [">&-", "2>&-", ">&- 2>&-", "2>/dev/full"])
def test_work_is_done_without_anybody_to_talk_to(redirection, tmp_path, folder):
    picture = tmp_path / "picture.exr"
    options = ["denoise", str(folder), "-o", str(picture), "--preset", "draft", "--iterations", "2"]
    program = shlex.join([sys.executable, "-c", MAIN.format("tungsten_dip"), *options])
    done = subprocess.run(["bash", "-c", f"{program} {redirection}"], capture_output=True, check=False)
    assert done.returncode == 0
    assert np.isfinite(read_image(picture)).all()


def test_a_name_that_is_no_text_is_refused_in_a_line(tmp_path, render, capfd):
    path = tmp_path / os.fsdecode(b"bad\xff.exr")
    write_image(path, render.reference)
    assert command.main(["inspect", str(path)]) == 2
    _, errors = capfd.readouterr()
    assert "expected a name in UTF-8; rename it" in errors
    assert len(errors.splitlines()) == 1


def test_control_characters_of_a_file_do_not_reach_the_terminal(tmp_path, capfd):
    path = tmp_path / "\x1b[31m.exr"
    layer = "\x1b]0;title\x07"
    names = (*"RGB", f"{layer}.U", f"{layer}.V")
    write_exr(path, [Part(dict.fromkeys(names, np.ones((3, 4), np.float32)))])
    assert command.main(["inspect", str(path)]) == 0
    output = str(tmp_path / "out.exr")
    assert command.main(["denoise", str(path), "-o", output, "--map", f"color={layer}"]) == 2
    told = "".join(capfd.readouterr())
    assert r"ignored: \x1b]0;title\x07" in told
    assert r"color=\x1b]0;title\x07: expected" in told
    assert not {"\x1b", "\x07"} & set(told)


@pytest.mark.parametrize("terminal", [True, False])
def test_control_characters_do_not_reach_the_terminal_by_the_progress(terminal, monkeypatch):
    stderr = io.StringIO()
    stderr.isatty = lambda: terminal
    monkeypatch.setattr(sys, "stderr", stderr)
    monkeypatch.setattr(console, "LINE_INTERVAL_S", 0.0)
    with progress_on_stderr("rendering \x1b]0;a\x07") as progress:
        progress(0.5, "frame \x9b31m")
    told = stderr.getvalue()
    assert r"rendering \x1b]0;a\x07" in told
    assert r"frame \x9b31m" in told
    assert not {"\x07", "\x9b"} & set(told)
    assert "\x1b]" not in told  # a bar moves the cursor by other sequences


def test_a_slow_start_does_not_count_for_the_time_left(monkeypatch, capsys):
    now = 0.0
    monkeypatch.setattr(console.time, "monotonic", lambda: now)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False)
    with progress_on_stderr("rendering") as progress:
        for seconds, fraction in ((10.0, 0.0), (20.0, 0.01), (25.0, 0.02), (29.0, 0.05), (30.0, 0.11)):
            now = seconds
            progress(fraction, "")
    lines = [
        "rendering: 0%",
        "rendering: 1%",
        "rendering: 2%",
        "rendering: 11%, 01:29 left",  # a tenth in the last 10 s
        "rendering: done in 00:30",
    ]
    assert capsys.readouterr().err.splitlines() == lines


@pytest.mark.parametrize("buffered", [True, False])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("tungsten_dip", "inspect {folder}"),
        ("tungsten_dip", "inspect {folder} --json"),
        ("tungsten_dip", "compare --help"),
        ("tungsten_dip", "--version"),
        ("tungsten", ""),
    ],
)
def test_a_stdout_that_is_full_is_named(name, options, buffered, folder):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", MAIN.format(name), *options.format(folder=folder).split()],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"},
        )
    assert done.returncode == 2
    assert "stdout: cannot be written (No space left on device); " in done.stderr.splitlines()[-1]


def test_ctrl_c_while_libraries_load_is_one_line():
    program = (
        "import signal; from tungsten_dip.cli import entry\n"
        "with entry._leaving_on_interrupt('tungsten'): signal.raise_signal(signal.SIGINT)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "tungsten: interrupted\n")


def test_ctrl_c_that_a_handler_in_c_has_is_left_to_it(monkeypatch):
    handler = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as of_c:
        of_c.setattr(signal, "getsignal", lambda number: None)
        with entry._leaving_on_interrupt("tungsten"):
            assert signal.signal(signal.SIGINT, handler) is handler


def test_ctrl_c_that_is_ignored_does_not_end_a_render(scene):
    program = (
        "import os, signal, sys\n"
        "from tungsten_dip.cli import entry\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "with entry._leaving_on_interrupt('tungsten'):\n"
        "    from tungsten_dip.hosts.mitsuba.render import render\n"
        "    from tungsten_dip.scene.parse import load_scene\n"
        "pressed = []\n"
        "def press(fraction, message):\n"
        "    if fraction < 1:\n"
        "        pressed.append(os.kill(os.getpid(), signal.SIGINT))\n"
        "render(load_scene(sys.argv[1]), spp=20000, threads=1, progress=press)\n"
        "assert pressed\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(scene)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("folder", [[], ["-d", "{tmp}/out"]])
def test_a_working_directory_that_is_gone_is_one_line(folder, scene, tmp_path):
    (tmp_path / "gone").mkdir()
    program = MAIN.format("tungsten").replace("sys.exit", "import os; os.rmdir(os.getcwd()); sys.exit")
    folder = [word.format(tmp=tmp_path) for word in folder]
    arguments = ["--host", "mitsuba", "--spp", "1", *folder, str(scene)]
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], cwd=tmp_path / "gone", capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "tungsten: the working directory does not exist any more" in done.stderr.splitlines()[-1]


def test_renders_in_a_working_directory_whose_name_is_no_text(scene, tmp_path):
    folder = tmp_path / os.fsdecode(b"bad\xff")
    folder.mkdir()
    arguments = ["--host", "mitsuba", "--spp", "1", "-d", str(tmp_path / "out"), str(scene)]
    done = subprocess.run(
        [sys.executable, "-c", MAIN.format("tungsten"), *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "picture.exr").exists()


def test_ctrl_c_waits_for_an_import():
    reached = []

    def load():
        with deferred_interrupts():
            signal.raise_signal(signal.SIGINT)
            reached.append("the end")

    with pytest.raises(KeyboardInterrupt):
        load()
    assert reached == ["the end"]


def test_ctrl_c_that_is_ignored_stays_so():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with deferred_interrupts():
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
