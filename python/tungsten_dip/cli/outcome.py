"""What a command of ``tungsten-dip`` has done, for the user to read and for programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Outcome:
    """``text`` is printed, or with ``--json`` the ``facts``; then the exit status is set.

    ``error`` is what could not be done although the rest was, in one line. ``interrupted`` says that Ctrl-C
    cut the work short, with a result written.
    """

    facts: dict[str, Any]
    text: str
    error: str | None = None
    interrupted: bool = False
