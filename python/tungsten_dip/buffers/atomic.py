"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tungsten_dip.errors import InputError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; what was written there replaces ``path`` on leaving.

    The temporary file has the suffix of ``path``. If the block raises, it is removed and ``path`` stays as
    it was. A process killed halfway leaves ``path`` as it was too.

    Raises InputError if the file system refuses (no such folder, read-only, full).
    """
    target = path.resolve()
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        temporary.replace(target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise InputError(f"{path}: cannot be written ({error.strerror or error}); {_REMEDY}") from error
        raise


def check_writable(path: Path, suffixes: tuple[str, ...] = (".exr",)) -> None:
    """Check before long work that its result can be saved as ``path``.

    Raises InputError if the suffix is none of ``suffixes``, or if no file can be created there.
    """
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: expected a file name that ends in {' or '.join(suffixes)}")
    if path.is_dir():
        raise InputError(f"{path}: expected the name of a file, this is a folder")
    probe = path.resolve().with_name(f".{secrets.token_hex(8)}")
    try:
        probe.touch(exist_ok=False)
        probe.unlink()
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); {_REMEDY}") from error


_REMEDY = "choose an existing folder that you may write to, on a disk with room"
