"""What the library logs, as a list: for reports, and from workers to whoever asked them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_REMARKS: ContextVar[tuple[list[str], ...]] = ContextVar("remarks", default=())
"""The lists of the blocks that the thread in hand is in."""


class _Collector(logging.Handler):
    """Adds a line to the lists of the thread that logs it."""

    def emit(self, record: logging.LogRecord) -> None:
        for remarks in _REMARKS.get():
            remarks.append(record.getMessage())


_COLLECTOR = _Collector(logging.INFO)

_LOCK = threading.Lock()
_open: list[logging.Handler] = []
_levels_before: list[int] = []
"""One for each block of `logging_to`, which may overlap in several threads."""


@contextmanager
def remarks_from_log() -> Iterator[list[str]]:
    """Yield a list of what the library logs within the block, in its thread.

    Other threads may do other work of this process. Those that a fit or a render starts for itself compute
    only, or repeat what was logged before.
    """
    remarks: list[str] = []
    token = _REMARKS.set((*_REMARKS.get(), remarks))
    try:
        with logging_to(_COLLECTOR):
            yield remarks
    finally:
        _REMARKS.reset(token)


@contextmanager
def logging_to(handler: logging.Handler) -> Iterator[None]:
    """Hand what the library logs at the handler's level and above to it, within the block alone.

    The level of the library's logger stays low until the last of all blocks ends.
    """
    logger = logging.getLogger("tungsten_dip")
    with _LOCK:
        _open.append(handler)
        _levels_before.append(logger.level)
        logger.setLevel(min(handler.level, logger.getEffectiveLevel()))
        logger.addHandler(handler)
    try:
        yield
    finally:
        with _LOCK:
            _open.remove(handler)
            if handler not in _open:
                logger.removeHandler(handler)
            level = _levels_before.pop()
            if not _open:
                logger.setLevel(level)
