"""What the library logs, as a list: for reports, and from workers to whoever asked them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def remarks_from_log() -> Iterator[list[str]]:
    """Yield a list of what the library logs within the block."""
    remarks: list[str] = []
    handler = logging.Handler(logging.INFO)
    handler.emit = lambda record: remarks.append(record.getMessage())  # type: ignore[method-assign]
    with logging_to(handler):
        yield remarks


@contextmanager
def logging_to(handler: logging.Handler) -> Iterator[None]:
    """Hand what the library logs at the handler's level and above to it, within the block alone."""
    logger = logging.getLogger("tungsten_dip")
    level = logger.level
    logger.setLevel(min(handler.level, logger.getEffectiveLevel()))
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
