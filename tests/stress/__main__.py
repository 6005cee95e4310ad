"""Everything that is tried to break the program: prints one table, and renews docs/hard-cases.md if asked to.

Run by ``make stress``; with names of parts (numerics, kills, hostile, load), runs these alone.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import hostile
import kills
import load
import numerics
import page
from row import Row, table


def main() -> int:
    """Run the parts and return 0 if everything held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help="numerics, kills, hostile, load (default: all)"
    )
    parser.add_argument(
        "--page", type=Path, help="a Markdown file whose last section tells what was measured"
    )
    options = parser.parse_args()
    logging.getLogger("tungsten_dip").setLevel(logging.CRITICAL)

    parts: dict[str, Callable[[Path], list[Row]]] = {
        "numerics": lambda _: _numerics(options.page),
        "kills": kills.rows,
        "hostile": hostile.rows,
        "load": load.rows,
    }
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, part in parts.items():
            if options.parts and name not in options.parts:
                continue
            started = time.monotonic()
            own = Path(folder) / name
            own.mkdir()
            rows += part(own)
            print(f"{name}: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    print(table(rows))
    return 0 if all(row.good for row in rows) else 1


def _numerics(destination: Path | None) -> list[Row]:
    measured = numerics.measured_cases()
    others = numerics.other_rows()
    if destination is not None:
        page.write_measured(destination, measured, others)
    return [*numerics.rows(measured), *others]


if __name__ == "__main__":
    sys.exit(main())
