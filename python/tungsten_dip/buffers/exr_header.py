"""The headers of an EXR file as OpenEXR's module reads them, without the attributes that it stumbles over."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import OpenEXR

_SEVERAL_PARTS = 0x10
"""In the second byte of the version: the file has several headers, one for each part."""


def read_headers(name: str) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the header of every part, and a line on each attribute that is left out.

    Python cannot hold texts that are not UTF-8, nor fractions whose denominator is 0. Raises what OpenEXR
    raises if the file is damaged.
    """
    left_out: list[str] = []
    try:
        file = OpenEXR.File(name, header_only=True)
    except (UnicodeDecodeError, ZeroDivisionError):  # as far as OpenEXR itself is concerned, it is sound
        with Path(name).open("rb") as stream:
            headers, left_out = _readable_headers(stream)
        file = OpenEXR.File(io.BytesIO(headers), header_only=True)
    return [part.header for part in file.parts], left_out


def escaped(text: bytes) -> str:
    r"""Return a text in which bytes that are not UTF-8 are written as \xe9."""
    return text.decode(errors="backslashreplace")


def _readable_headers(stream: BinaryIO) -> tuple[bytes, list[str]]:
    """Return a sound file as far as its last header, and a line on each attribute that was taken out.

    After 8 bytes, a header is a series of attributes: name, 0, type, 0, the size of the value in 4 bytes, the
    value. A 0 ends it, and one more the last of several ("OpenEXR File Layout", openexr.com).
    """
    kept = bytearray(stream.read(8))
    left_out = []
    ends, ended = 2 if kept[5] & _SEVERAL_PARTS else 1, 0
    while ended < ends:
        name = _text(stream)
        if not name:
            kept += b"\0"
            ended += 1
            continue
        ended = 0
        kind, size = _text(stream), stream.read(4)
        value = stream.read(int.from_bytes(size, "little"))
        if name == b"name":  # a part must have one
            value = escaped(value).encode()
            size = len(value).to_bytes(4, "little")
        elif reason := _why_unreadable(name, kind, value):
            left_out.append(f"attribute {escaped(name)} is left out: {reason}")
            continue
        kept += b"\0".join((name, kind, size + value))
    return bytes(kept), left_out


def _text(stream: BinaryIO) -> bytes:
    """Read up to the next 0."""
    text = bytearray()
    while (byte := stream.read(1)) not in (b"\0", b""):
        text += byte
    return bytes(text)


def _why_unreadable(name: bytes, kind: bytes, value: bytes) -> str:
    if kind == b"rational" and value[4:] == bytes(4):
        return "expected a fraction, got one whose denominator is 0"
    try:
        for text in (name, *_texts(kind, value)):
            text.decode()
    except UnicodeDecodeError:
        return f"expected text in UTF-8, got '{escaped(text[:40]):.40}'"
    return ""


def _texts(kind: bytes, value: bytes) -> Iterator[bytes]:
    if kind == b"string":
        yield value
    stream = io.BytesIO(value if kind == b"stringvector" else b"")
    while size := stream.read(4):
        yield stream.read(int.from_bytes(size, "little"))
