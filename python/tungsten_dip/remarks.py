"""What the library logs, as a list: for reports, and from workers to whoever asked them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_LOCK = threading.Lock()
_open: list[logging.Handler] = []
_level_before = logging.NOTSET
"""Blocks of `logging_to` may overlap in several threads; the level is that of the time without any."""


class _Collector(logging.Handler):
    """Adds the lines that one thread logs to a list."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.remarks: list[str] = []
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            self.remarks.append(record.getMessage())


@contextmanager
def remarks_from_log() -> Iterator[list[str]]:
    """Yield a list of what the library logs within the block, in its thread.

    Other threads may do other work of this process. Those that a fit or a render starts for itself compute
    only, or repeat what was logged before.
    """
    collector = _Collector()
    with logging_to(collector):
        yield collector.remarks


@contextmanager
def logging_to(handler: logging.Handler) -> Iterator[None]:
    """Hand what the library logs at the handler's level and above to it, within the block alone.

    The level of the library's logger stays low until the last of all blocks ends.
    """
    global _level_before
    logger = logging.getLogger("tungsten_dip")
    with _LOCK:
        if not _open:
            _level_before = logger.level
        _open.append(handler)
        logger.setLevel(min(handler.level, logger.getEffectiveLevel()))
        logger.addHandler(handler)
    try:
        yield
    finally:
        with _LOCK:
            logger.removeHandler(handler)
            _open.remove(handler)
            if not _open:
                logger.setLevel(_level_before)
