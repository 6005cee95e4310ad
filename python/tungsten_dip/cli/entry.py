"""Where the commands begin: Ctrl-C ends a process that is still loading its libraries with one line.

Python would raise it in the midst of an import, which libraries answer with tracebacks or a crash.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

_INTERRUPTED = 130  # `console.EXIT_INTERRUPTED`, without the libraries that importing it loads


def tungsten() -> int:
    """Run ``tungsten``."""
    with _leaving_on_interrupt("tungsten"):
        from tungsten_dip.cli.tungsten import main
    return main()


def tungsten_dip() -> int:
    """Run ``tungsten-dip``."""
    with _leaving_on_interrupt("tungsten-dip"):
        from tungsten_dip.cli.tungsten_dip import main
    return main()


@contextmanager
def _leaving_on_interrupt(command: str) -> Iterator[None]:
    def leave(number: int, frame: object) -> None:
        os.write(2, f"{command}: interrupted\n".encode())
        os._exit(_INTERRUPTED)

    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        # As of a process in the background; Mitsuba, which has a handler of its own, shall not see it either.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    if before in (signal.SIG_IGN, None):  # None is a handler that was not set from Python
        yield
        return
    signal.signal(signal.SIGINT, leave)
    yield
    signal.signal(signal.SIGINT, before)
