"""Coverage-guided fuzzing of every reader with atheris: ``make fuzz``, or one reader by its name.

Prints the executions of every reader and the input of a crash. A crash becomes a test and is mended.
"""

from __future__ import annotations

import argparse
import logging
import re
import subprocess
import sys
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["tungsten_dip"]):
    from readers import READERS
    from tungsten_dip.errors import InputError

MOST_BYTES = 1 << 16
FOLDER = Path(__file__).parents[2] / "build" / "fuzz"


def main() -> int:
    """Fuzz one reader in this process, or every reader in a process each; return 0 if none broke."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=int, default=60, help="for every reader")
    parser.add_argument("reader", nargs="?", choices=tuple(READERS))
    options = parser.parse_args()
    if options.reader:
        _fuzz(options.reader, options.seconds)
    broken = 0
    for name in READERS:
        done = subprocess.run(
            [sys.executable, *sys.orig_argv[1:2], "--seconds", str(options.seconds), name],
            capture_output=True,
            text=True,
        )
        executions = re.search(r"(?:Done |stat::number_of_executed_units: )(\d+)", done.stderr)
        print(f"{name}: {executions[1] if executions else '?'} executions", end="")
        print(", nothing found" if done.returncode == 0 else f", BROKEN:\n{done.stderr[-3000:]}", flush=True)
        broken += done.returncode != 0
    return 1 if broken else 0


def _fuzz(name: str, seconds: int) -> None:
    """Does not return."""
    logging.disable(logging.CRITICAL)
    reader = READERS[name]
    # What an earlier run found to reach new code is kept, and gone on from.
    folder = FOLDER / re.sub(r"\W+", "-", name)
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, example in enumerate(reader.examples()):
        (corpus / str(number)).write_bytes(example)
    path = folder / f"input{reader.suffix}"

    def read(content: bytes) -> None:
        path.write_bytes(content)
        try:
            reader.read(path)
        except InputError as refused:
            if "\n" in str(refused):
                raise RuntimeError("more than one line") from refused

    limits = [f"-max_total_time={seconds}", f"-max_len={MOST_BYTES}", "-rss_limit_mb=4096", "-timeout=20"]
    output = [f"-artifact_prefix={folder}/", "-print_final_stats=1"]
    atheris.Setup([sys.argv[0], *limits, *output, str(corpus)], read)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
