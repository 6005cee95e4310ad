"""How the commands talk: log lines and progress on stderr, one JSON object on stdout, exit statuses."""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

from tqdm import tqdm

from tungsten_dip.cli.outcome import Outcome
from tungsten_dip.errors import InputError
from tungsten_dip.failures import line_of_failure
from tungsten_dip.remarks import logging_to

tqdm.get_lock()  # made on first use otherwise, which Ctrl-C must not cut short

EXIT_INTERNAL, EXIT_INPUT, EXIT_INTERRUPTED = 1, 2, 130

DEBUG_VARIABLE = "TUNGSTEN_DIP_DEBUG"
"""Set in the environment, it lets tracebacks through."""

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")

SECONDS_BY_UNIT = {"ms": 0.001, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}

_NUMBER_AND_UNIT = r"(\d+(?:\.\d*)?|\.\d+)(ms|[smhd]|$)"
"""Matches no text in two ways: the texts of a scene file may be long, and must not take long to refuse."""

LINE_INTERVAL_S = 5.0
"""How often progress is reported where there is no terminal to draw a bar on."""

_LEAST_DONE = 0.02
"""The part of the work whose speed foretells the rest."""


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line and whose options are never abbreviated."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        """Raise InputError in place of argparse's two lines."""
        raise InputError(f"{message}; see '{self.prog} --help'")

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print the help or the version. Raises InputError if that fails, of which argparse says nothing."""
        with writing_stdout():
            print(message, end="", file=file, flush=True)


def run(command: str, body: Callable[[], None]) -> int:
    """Run a command's body and return its exit status; whatever goes wrong becomes one line on stderr."""
    debug = bool(os.environ.get(DEBUG_VARIABLE))
    _replace_closed_streams()
    try:
        with _log_on_stderr(command, logging.DEBUG if debug else logging.INFO):
            body()
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _fail(command, "interrupted", EXIT_INTERRUPTED)
    except BrokenPipeError:
        _discard_stdout()  # whose reader has had enough
        return EXIT_INTERNAL
    except Exception as error:
        if debug:
            raise
        return _fail(command, *line_and_status(error))
    return 0


def line_and_status(error: Exception) -> tuple[str, int]:
    """Return what is told of an error, in one line, and the exit status of a command that it ends."""
    line, mendable = line_of_failure(error)
    if mendable:
        return line, EXIT_INPUT
    return f"internal error: {line}; set {DEBUG_VARIABLE}=1 to see where", EXIT_INTERNAL


@contextmanager
def outcome_on_stdout(as_json: bool) -> Iterator[Callable[[Outcome], None]]:
    """Yield the function that prints the outcome of the block: its text or, as JSON, its facts.

    JSON is alone on stdout: all else written there in the block, by libraries too, goes to stderr. Numbers
    that JSON has no name for (NaN, Inf) become null.
    """
    if not as_json:
        yield lambda outcome: _print(outcome.text)
        return
    sys.stdout.flush()
    stdout = os.dup(1)
    os.dup2(2, 1)

    def print_facts(outcome: Outcome) -> None:
        # A plain os.write may write a part, and say so in what it returns alone.
        with os.fdopen(os.dup(stdout), "w", encoding="utf-8") as stream:
            stream.write(json.dumps(_finite(outcome.facts), indent=1) + "\n")

    try:
        yield print_facts
    finally:
        sys.stdout.flush()
        os.dup2(stdout, 1)
        os.close(stdout)


def _print(text: str) -> None:
    encoding = sys.stdout.encoding or "utf-8"
    # Names of files need not be text.
    print(printable(text).encode(encoding, "backslashreplace").decode(encoding), flush=True)


@contextmanager
def writing_stdout() -> Iterator[None]:
    """Make what stdout refuses an InputError, unless its reader is gone (see `run`)."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        _discard_stdout()
        raise InputError(
            f"stdout: cannot be written ({error.strerror}); redirect it elsewhere, any files asked for are "
            f"written"
        ) from error


def _discard_stdout() -> None:
    """Let what stdout has not taken go nowhere: Python would complain when it flushes at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


@contextmanager
def progress_on_stderr(what: str) -> Iterator[Callable[[float, str], None]]:
    """Yield a progress callback: a bar with the time left, or a line now and then off a terminal.

    The line tells the time left by the speed since the first progress: what comes before it, such as reading
    meshes, happens once.
    """
    if sys.stderr.isatty():
        with tqdm(
            total=1.0,
            desc=printable(what),
            bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed} <{remaining}{postfix}",
        ) as bar:

            def draw(fraction: float, message: str) -> None:
                bar.set_postfix_str(printable(message), refresh=False)
                bar.update(max(0.0, min(fraction, 1.0) - bar.n))

            yield draw
        return

    start = last = time.monotonic()
    first: tuple[float, float] | None = None

    def tell(fraction: float, message: str) -> None:
        nonlocal last, first
        now = time.monotonic()
        if first is None and fraction > 0:
            first = now, fraction
        if now - last < LINE_INTERVAL_S:
            return
        last = now
        left = ""
        if first is not None and (done := fraction - first[1]) >= _LEAST_DONE:
            left = f", {tqdm.format_interval((now - first[0]) * (1 - fraction) / done)} left"
        _tell(f"{what}: {fraction:.0%}{left}{', ' + message if message else ''}")

    yield tell
    _tell(f"{what}: done in {tqdm.format_interval(time.monotonic() - start)}")


def add_threads(parser: argparse._ActionsContainer) -> None:
    """Add ``--threads``."""
    parser.add_argument("--threads", metavar="N", type=int, help="how many cores to use (default: all)")


def add_json(parser: argparse._ActionsContainer) -> None:
    """Add ``--json`` (`outcome_on_stdout`)."""
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout, nothing else")


def integers(text: str) -> tuple[int, ...]:
    """Return the integers of ``1,7,13``.

    Raises argparse.ArgumentTypeError if the text is anything else.
    """
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected integers such as 1,7,13, got '{text}'") from None


def duration(text: str, default_unit: str = "s") -> float:
    """Return the seconds of ``90s``, ``5m``, ``1.5h`` or ``1h30m``; a bare number has the default unit.

    Raises argparse.ArgumentTypeError if the text is none of these.
    """
    compact = "".join(text.split()).lower()
    seconds = math.inf
    if re.fullmatch(f"(?:{_NUMBER_AND_UNIT})+", compact):
        parts = re.findall(_NUMBER_AND_UNIT, compact)
        seconds = sum(float(number) * SECONDS_BY_UNIT[unit or default_unit] for number, unit in parts)
    if not math.isfinite(seconds):  # nor is the value of some hundred digits
        raise argparse.ArgumentTypeError(f"expected a duration such as 90s, 5m or 1.5h, got '{text:.60}'")
    return seconds


def minutes(text: str) -> float:
    """Return the seconds of a duration as Tungsten reads it: a bare number means minutes."""
    return duration(text, default_unit="m")


def printable(text: str) -> str:
    """Return a text with its control characters escaped, but for newlines and tabs.

    A terminal obeys those in the names of a file and its layers.
    """
    return _CONTROL.sub(lambda match: f"\\x{ord(match[0]):02x}", text)


class _StderrHandler(logging.Handler):
    """Writes log lines above a progress bar, if one is being drawn."""

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):
            tqdm.write(printable(self.format(record)), file=sys.stderr)


@contextmanager
def _log_on_stderr(command: str, level: int) -> Iterator[None]:
    handler = _StderrHandler(level)
    handler.setFormatter(logging.Formatter(f"{command}: %(message)s"))
    with logging_to(handler):
        yield


def _fail(command: str, message: str, status: int) -> int:
    _tell(f"{command}: {message}")
    return status


def _tell(line: str) -> None:
    """Print a line on stderr; a full disk or a reader that is gone there must not end the work."""
    with suppress(OSError):
        print(printable(line), file=sys.stderr, flush=True)


def _replace_closed_streams() -> None:
    """Open what the shell has closed (``>&-``), lest a picture be opened in its place and written to."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
