"""Mitsuba itself: the one place that imports it, chooses its variant and shows it our plugins."""

from __future__ import annotations

import importlib
import importlib.metadata
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from tungsten_dip.errors import InputError
from tungsten_dip.extras import require
from tungsten_dip.interrupts import deferred_interrupts

_LOG = logging.getLogger(__name__)

VARIANT = "scalar_rgb"
"""The variant that our plugins are compiled for: it needs no LLVM and gives the same bits everywhere."""

VERSION = "3.9.1"
"""The release that our plugins are compiled against; another one lays out its objects differently."""

_PLUGIN_PARENT = Path(__file__).parent


@contextmanager
def mitsuba_variant() -> Iterator[ModuleType]:
    """Give the module `mitsuba` in our variant, knowing our plugins and writing to Python's log.

    The caller's variant and log are back afterwards. May be nested.

    Raises InputError if Mitsuba, our plugins or the working directory are missing.
    """
    require("mitsuba", "rendering")
    installed = importlib.metadata.version("mitsuba")
    if installed != VERSION:
        raise InputError(
            f"rendering needs mitsuba {VERSION}, found {installed}: pip install 'tungsten-dip[mitsuba]'"
        )
    if not (_PLUGIN_PARENT / "plugins" / "tungsten_path.so").exists():
        raise InputError(
            "tungsten-dip was built without its Mitsuba plugins; install mitsuba, then build it again"
        )
    try:
        Path.cwd()  # without which importing Mitsuba ends the process
    except OSError:
        raise InputError("the working directory does not exist any more; change to one that does") from None
    with deferred_interrupts():
        mitsuba = importlib.import_module("mitsuba")
        previous_variant = mitsuba.variant()
        mitsuba.set_variant(VARIANT)
    resolver = mitsuba.file_resolver()
    # Not compared as texts: a working directory whose name is not UTF-8 is none.
    if mitsuba.filesystem.path(str(_PLUGIN_PARENT)) not in list(resolver):
        resolver.append(str(_PLUGIN_PARENT))
    logger = mitsuba.logger()
    previous_appenders = [logger.appender(i) for i in range(logger.appender_count())]
    logger.clear_appenders()
    logger.add_appender(_log_appender(mitsuba))
    try:
        yield mitsuba
    finally:
        logger.clear_appenders()
        for appender in previous_appenders:
            logger.add_appender(appender)
        if previous_variant is not None:
            mitsuba.set_variant(previous_variant)


def _log_appender(mitsuba: Any) -> Any:
    class LogAppender(mitsuba.Appender):  # type: ignore[misc]
        """Hands Mitsuba's messages, which go to stdout otherwise, to Python's log."""

        def append(self, level: Any, text: str) -> None:
            is_warning = level >= mitsuba.LogLevel.Warn
            _LOG.log(logging.WARNING if is_warning else logging.DEBUG, "%s", text)

        def log_progress(self, *_: object) -> None:
            """Progress is polled from the integrator instead."""

    return LogAppender()
