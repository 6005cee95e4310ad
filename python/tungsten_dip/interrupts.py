"""Defers Ctrl-C while libraries load, and raises it again after a fit that it ended early."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager


def held_interrupts() -> AbstractContextManager[None]:
    """Raise a KeyboardInterrupt that comes within the block at its end: for imports of libraries.

    Those that are interrupted while they load leave half of themselves behind, or end the process.
    """
    return _noted_interrupts(at_once=False)


def heeded_interrupts() -> AbstractContextManager[None]:
    """Raise a KeyboardInterrupt within the block where it comes and, if it is caught there, again at its end.

    A fit ends early on it with what it has.
    """
    return _noted_interrupts(at_once=True)


@contextmanager
def _noted_interrupts(at_once: bool) -> Iterator[None]:
    in_main_thread = threading.current_thread() is threading.main_thread()
    # A job in the background of a shell ignores Ctrl-C; None is a handler that Python does not know.
    if not in_main_thread or signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, None):
        yield
        return
    pressed = False

    def note(number: int, frame: object) -> None:
        nonlocal pressed
        pressed = True
        if at_once:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt
