"""Defers Ctrl-C while libraries load, and raises it again after a fit that it ended early."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager


def held_interrupts() -> AbstractContextManager[None]:
    """Defer Ctrl-C within the block to its end: for imports of libraries.

    An import that is interrupted leaves a module half initialised, or ends the process.
    """
    return _noted_interrupts(at_once=False)


def heeded_interrupts() -> AbstractContextManager[None]:
    """Raise KeyboardInterrupt on Ctrl-C within the block and, if it is caught there, again at its end.

    A fit catches it, and ends early with the result so far.
    """
    return _noted_interrupts(at_once=True)


@contextmanager
def _noted_interrupts(at_once: bool) -> Iterator[None]:
    in_main_thread = threading.current_thread() is threading.main_thread()
    # A background job of a shell ignores Ctrl-C; None is a handler that was not installed from Python.
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
