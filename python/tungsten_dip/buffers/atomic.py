"""Files that appear whole or not at all."""

from __future__ import annotations

import fcntl
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tungsten_dip.errors import InputError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; what was written there replaces ``path`` on leaving.

    The temporary file has the suffix of ``path``. If the block raises, it is removed and ``path`` stays as
    it was. A process killed halfway leaves ``path`` as it was too, and a hidden temporary file, which goes
    when ``path`` is next written.

    Raises InputError if the file system refuses (no such folder, read-only, full), or if no file can have
    the name.
    """
    try:
        target = _resolved(path)
        _remove_left_by_the_dead(target)
        with _locked_temporary(target) as temporary:
            yield temporary
            with temporary.open("rb+") as written:
                os.fsync(written.fileno())
            temporary.replace(target)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); {_REMEDY}") from error


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8, whole or not at all; what is no UTF-8 of the names of files is escaped.

    Raises InputError if the file system refuses.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def check_suffix(path: Path, *suffixes: str) -> None:
    """Raise InputError if a name ends in none of these."""
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: expected a file name that ends in {' or '.join(suffixes)}")


def check_writable(path: Path, *suffixes: str) -> None:
    """Check before long work that its result can be saved as ``path``.

    Raises InputError if the suffix is none of ``suffixes``, or if no file can be created there.
    """
    check_suffix(path, *suffixes)
    try:
        if path.is_dir():
            raise InputError(f"{path}: expected the name of a file, this is a folder")
        target = _resolved(path)
        if path.suffix.lower() in _BY_OPENIMAGEIO and not is_utf8(target.parent):
            raise InputError(
                f"{path}: expected a folder with a name in UTF-8 for {path.suffix}; choose another"
            )
        temporary = _temporary(target)
        temporary.open("xb").close()
        temporary.unlink(missing_ok=True)  # as another process may have done, which took its writer for dead
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); {_REMEDY}") from error


def is_utf8(path: Path) -> bool:
    """Return whether the bytes of a path are UTF-8, whatever the locale takes them for."""
    try:
        os.fsencode(path).decode()
    except UnicodeError:
        return False
    return True


def _resolved(path: Path) -> Path:
    try:
        return path.resolve()
    except RuntimeError as error:  # as Python 3.11 and 3.12 have it
        raise InputError(f"{path}: cannot be written (a loop of links); {_REMEDY}") from error
    except ValueError as error:
        raise InputError(f"{path}: expected a name that a file can have ({error}); rename it") from error


def _temporary(target: Path) -> Path:
    return target.with_name(f"{_prefix(target)}{secrets.token_hex(_TOKEN_BYTES)}{_end(target)}")


def _prefix(target: Path) -> str:
    """Return what the names of temporary files begin with: the stem's ASCII, cut lest they be too long."""
    return f".{os.fsencode(target.stem)[:_MOST_OF_STEM_BYTES].decode('ascii', errors='ignore')}-"


def _end(target: Path) -> str:
    """Return what the names of temporary files end with.

    It marks them, lest a file of the user's with a date in its name pass for one.
    """
    return f".tungsten-dip{target.suffix}"


@contextmanager
def _locked_temporary(target: Path) -> Iterator[Path]:
    """Create a temporary file and hold the lock that shows that its writer lives; remove it on leaving."""
    while True:
        temporary = _temporary(target)
        try:
            with temporary.open("xb") as file:
                with suppress(OSError):  # of a file system without locks, where nothing is removed either
                    fcntl.flock(file, fcntl.LOCK_EX)
                if temporary.exists():  # Until it was locked, another process could take its writer for dead.
                    yield temporary
                    return
        finally:
            with suppress(OSError):  # such as that it is in its place, or that its name is too long to exist
                temporary.unlink()


def _remove_left_by_the_dead(target: Path) -> None:
    """Remove temporary files of ``target`` whose writers live no more: these alone are not locked."""
    name = re.compile(
        re.escape(_prefix(target)) + f"[0-9a-f]{{{2 * _TOKEN_BYTES}}}" + re.escape(_end(target))
    )
    with suppress(OSError):
        for path in target.parent.iterdir():
            if name.fullmatch(path.name):
                with suppress(OSError), path.open("rb") as left:
                    fcntl.flock(left, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    path.unlink()


_BY_OPENIMAGEIO = (".png", ".pfm", ".hdr")
"""It takes paths in UTF-8 alone. The names of temporary files are ASCII, whatever the target's."""

_TOKEN_BYTES = 4
_MOST_OF_STEM_BYTES = 100
_REMEDY = "choose an existing folder that you may write to, on a disk with room"
