"""Ctrl-C where Python must not raise it at once, or not only then."""

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
    if threading.current_thread() is not threading.main_thread():
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
