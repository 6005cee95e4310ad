"""docs/hard-cases.md: every case, what is promised of it, and what was measured."""

from __future__ import annotations

from hard_cases import HEIGHT, PROMISES, SPP, WIDTH
from numerics import EXPOSURES, FEW_STEPS, PATHS, PAPER, Measured
from row import Row, table

_INTRODUCTION = f"""# Hard cases

Renderers produce ugly data, machines die, files lie. This page lists what is tried against it, what is promised, and
what was measured. `make stress` tries all of it and prints one table; `make stress PAGE=docs/hard-cases.md` also writes
the tables of this page anew. `make test` holds a fast slice (`tests/python/test_hard_cases.py`).

## Promises

{{promises}}

A promise that does not hold for a case is named beneath the table of its group, with the reason.

## Numerical cases

Every case (`tests/python/hard_cases.py`) damages a render of {WIDTH}x{HEIGHT} pixels at {SPP} spp whose truth is known:
a sphere on a checkered floor before a sky. It goes through the preset draft with all its steps (twice, with one thread
and with two, and at exposures of {" and ".join(f"2^{e}" for e in EXPOSURES)}), through balanced and final with {FEW_STEPS}
steps, paper with {PAPER.iterations} (of which only finite values are promised), a warm start from the network of the
undamaged render, and onnxruntime.

*Error* is the relMSE of undamaged pixels, of the input and of the result of draft; *mean* how far the mean radiance
out of reach of the damage has moved; *harm* the error there, relative to that without the damage. The last column
names the ways ({", ".join(PATHS)}) in which all promises held, or what did not.
"""


def catalogue(measured: list[Measured], others: list[Row]) -> str:
    """Return the page."""
    promises = "\n".join(f"- **{name}**: {text}." for name, text in PROMISES.items())
    parts = [_INTRODUCTION.format(promises=promises)]
    for group in dict.fromkeys(m.case.group for m in measured):
        of_group = [m for m in measured if m.case.group == group]
        lines = [f"### {group}", "", "| case | error | mean | harm | ways |", "|---|---|---|---|---|"]
        lines += [_line(m) for m in of_group]
        reasons = {(promise, reason): None for m in of_group for promise, reason in m.case.unpromised.items()}
        for promise, reason in reasons:
            names = [m.case.name for m in of_group if m.case.unpromised.get(promise) == reason]
            lines += ["", f"*{promise}* is not promised for: {', '.join(names)}. Reason: {reason}."]
        parts.append("\n".join(lines) + "\n")
    parts.append("### Beside the catalogue\n\n" + table(others) + "\n")
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
