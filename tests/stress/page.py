"""The last section of docs/hard-cases.md: every case, and what was measured."""

from __future__ import annotations

from pathlib import Path

from numerics import Measured
from row import Row, table

_HEADING = "## Measured\n"


def write_measured(path: Path, measured: list[Measured], others: list[Row]) -> None:
    """Replace what follows the heading "Measured" in a file."""
    kept, heading, _ = path.read_text(encoding="utf-8").partition(_HEADING)
    path.write_text(kept + heading + "\n" + _tables(measured, others), encoding="utf-8")


def _tables(measured: list[Measured], others: list[Row]) -> str:
    parts = [] if all(m.held for m in measured) else ["In bold: a promise that is not yet kept.\n"]
    for group in dict.fromkeys(m.case.group for m in measured):
        of_group = [m for m in measured if m.case.group == group]
        lines = [f"### {group}", "", "| case | error | mean | harm | ways |", "|---|---|---|---|---|"]
        lines += [_line(m) for m in of_group]
        reasons = {(promise, reason): None for m in of_group for promise, reason in m.case.unpromised.items()}
        for promise, reason in reasons:
            names = [m.case.name for m in of_group if m.case.unpromised.get(promise) == reason]
            lines += ["", f"*{promise}* is not promised for: {'; '.join(names)}. Reason: {reason}."]
        parts.append("\n".join(lines) + "\n")
    parts.append("### Other trials\n\n" + table(others) + "\n")
    return "\n".join(parts)


def _line(measured: Measured) -> str:
    draft = measured.draft
    error = mean = harm = "-"
    if draft.error is not None and draft.input_error is not None:
        error = f"{draft.input_error:.2g} to {draft.error:.2g}"
    if draft.drift is not None:
        mean = f"{draft.drift:+.2%}"
    if draft.harm is not None:
        harm = f"{draft.harm:.2f}"
    broken = "; ".join(f"**{path}: {', '.join(texts)}**" for path, texts in measured.broken.items() if texts)
    return f"| {measured.case.name} | {error} | {mean} | {harm} | {broken or 'all'} |"
