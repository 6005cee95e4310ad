"""What Ctrl-C does while libraries load, a fit trains or a thread waits; and SIGTERM beside workers."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from typing import Any

_LOG = logging.getLogger(__name__)

_TURN_S = 0.1


@contextmanager
def deferred_interrupts() -> Iterator[None]:
    """Defer Ctrl-C within the block to its end.

    For imports of libraries, which would leave a module half initialised or end the process.
    """
    pressed = False

    def note() -> None:
        nonlocal pressed
        pressed = True

    with _on_signal(signal.SIGINT, note):
        yield
    if pressed:
        raise KeyboardInterrupt


@contextmanager
def interrupts_as_requests(warning: str) -> Iterator[Callable[[], bool]]:
    """Turn a first Ctrl-C within the block into a request that can be asked for; a second ends the process.

    The warning is logged at the first.
    """
    requested = False

    def request() -> None:
        nonlocal requested
        requested = True
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        _LOG.warning(warning)

    with _on_signal(signal.SIGINT, request):
        yield lambda: requested


def wait_in_short_turns(pending: Future[Any], between: Callable[[], None] = lambda: None) -> None:
    """Wait until another thread has finished, and call ``between`` after every turn.

    A Ctrl-C just before a single wait would be noticed at its end only.
    """
    while not wait([pending], timeout=_TURN_S).done:
        between()


@contextmanager
def terminations_as_interrupts() -> Iterator[Callable[[], None]]:
    """Raise KeyboardInterrupt on SIGTERM within the block: for processes that are to end before this one.

    If it was lost within, as in a finaliser, calling what the block is given raises it, and so does its end.
    """
    asked = False

    def raise_if_asked() -> None:
        if asked:
            raise KeyboardInterrupt

    def interrupt() -> None:
        nonlocal asked
        asked = True
        raise KeyboardInterrupt

    with _on_signal(signal.SIGTERM, interrupt):
        yield raise_if_asked
    raise_if_asked()


@contextmanager
def _on_signal(number: signal.Signals, handle: Callable[[], None]) -> Iterator[None]:
    in_main_thread = threading.current_thread() is threading.main_thread()
    # A background job of a shell ignores Ctrl-C; None is a handler that was not installed from Python.
    if not in_main_thread or signal.getsignal(number) in (signal.SIG_IGN, None):
        yield
        return
    before = signal.signal(number, lambda _, frame: handle())
    try:
        yield
    finally:
        signal.signal(number, before)
