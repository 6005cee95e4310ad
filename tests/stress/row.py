"""One line of the table that `make stress` prints."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """What was tried, how often, how often all that is promised held, and what did not hold (or was lost)."""

    what: str
    tried: int
    held: int
    lost: tuple[str, ...] = ()
    note: str = ""

    @property
    def good(self) -> bool:
        """Whether everything held."""
        return self.held == self.tried


def table(rows: list[Row]) -> str:
    """Return the rows as Markdown, and beneath it what was lost."""
    lines = ["| what | tried | held | lost | |", "|---|---:|---:|---|---|"]
    lines += [f"| {r.what} | {r.tried} | {r.held} | {len(r.lost) or 'nothing'} | {r.note} |" for r in rows]
    lines += [f"lost: {row.what}: {what}" for row in rows for what in row.lost]
    return "\n".join(lines)
