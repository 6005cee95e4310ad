"""JSON as Tungsten reads it: comments and trailing commas are allowed."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path
from typing import Any

from tungsten_dip.errors import InputError

_LOG = logging.getLogger(__name__)


def object_from_json_file(path: Path) -> dict[str, Any]:
    """Read a scene file.

    Of keys that appear twice in one object, the first is used and a warning logged.

    Raises InputError, one line with the place, if the file cannot be read or holds no object.
    """
    try:
        content = path.read_bytes() if path.is_file() else None
        in_zip = any(parent.suffix.lower() == ".zip" and parent.is_file() for parent in path.parents)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); check the path and the permissions") from None
    if content is None:
        found = "a zip on the way to it" if in_zip else "a folder" if path.is_dir() else "none"
        remedy = "unpack it" if in_zip else "check the path"
        raise InputError(f"{path}: expected a Tungsten scene file, found {found}; {remedy}")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # As old programs on Windows write it. The files that it names mostly have names in UTF-8 here.
        text = content.decode("latin-1")

    repeated: set[str] = set()

    def first_of_equal_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        fields: dict[str, Any] = {}
        for key, value in pairs:
            if key in fields:
                repeated.add(key)
            else:
                fields[key] = value
        return fields

    try:
        raw = json.loads(_plain_json(text), object_pairs_hook=first_of_equal_keys)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path}:{error.lineno}:{error.colno}: expected JSON, got a syntax error ({error.msg}); "
            "correct that line"
        ) from None
    except RecursionError:
        raise InputError(f"{path}: JSON is nested too deeply; flatten the scene") from None
    except ValueError as error:
        raise InputError(
            f"{path}: expected JSON, got a number of too many digits ({error}); shorten it"
        ) from None
    if not isinstance(raw, dict):
        raise InputError(
            f"{path}: expected a JSON object with primitives and a camera, got {shown(raw)}; correct the file"
        )
    if repeated:
        listed = ", ".join(sorted(shown(key) for key in repeated))
        _LOG.warning("%s: keys that appear twice in one object, the first is used: %s", path, listed[:500])
    return raw


def shown(value: object) -> str:
    """Show a value of the file on one line, whatever its size."""
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return f"an array of {len(value)}"
    text = json.dumps(value) if not isinstance(value, int) or abs(value) < 10**40 else "a huge number"
    return text if len(text) <= 60 else text[:57] + '..."'


def _plain_json(text: str) -> str:
    """Blank out comments and trailing commas, which Tungsten allows, keeping every line and column."""

    def blank(match: re.Match[str]) -> str:
        token = match.group()
        return token if token.startswith('"') else re.sub(r"[^\n]", " ", token)

    string = r'"(?:[^"\\]|\\.)*"?'
    text = re.sub(rf"{string}|//[^\n]*|/\*(?:.*?\*/|.*)", blank, text, flags=re.DOTALL)
    return re.sub(rf"{string}|,(?=\s*[}}\]])", blank, text, flags=re.DOTALL)
