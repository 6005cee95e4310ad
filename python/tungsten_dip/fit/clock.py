"""The time of a fit."""

from __future__ import annotations

import time
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Clock:
    """Counts from when it was made; ``budget_s`` is the time that there is, None for as much as it takes."""

    budget_s: float | None = None
    _started: float = field(default_factory=time.perf_counter)

    def seconds(self) -> float:
        """How long ago the clock was made."""
        return time.perf_counter() - self._started

    def share_spent(self) -> float:
        """The part of the budget that is spent, above 1 after its end; 0 without a budget."""
        return self.seconds() / self.budget_s if self.budget_s else 0.0
