"""The one reader of a checkpoint's JSON, which others wrote. Standard library only.

It returns plain data, as strict as `strict_json` makes it. Whoever reads a field says which type it has,
with the functions below.
"""

import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any  # Any: JSON of another program

from vla_eval.errors import CheckpointError
from vla_eval.strict.json_text import loads, shown

MAX_BYTES = 64 << 20  # the largest that were seen hold statistics of dozens of datasets: under 1 MiB
FETCH_AGAIN = "Fetch the checkpoint again, from where you trust it."
WORDS: Mapping[type, str] = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    list: "a list",
    dict: "a mapping",
    type(None): "nothing",
}


def read_json(path: Path) -> dict[str, Any]:
    """Return the mapping that a JSON file holds.

    Raises:
        CheckpointError: it is missing, no file, too large, or not such JSON.
    """
    return parse_json(_content(path), where=str(path))


def parse_json(content: bytes, *, where: str) -> dict[str, Any]:
    """Return the mapping that JSON holds.

    Args:
        content: the bytes of a file.
        where: the file, for messages.

    Raises:
        CheckpointError: it is no JSON, or holds something else.
    """
    try:
        data = loads(content)
    except ValueError as exc:  # json's and UTF-8's own are such errors
        raise _damaged(where, str(exc)) from exc
    if not isinstance(data, dict):
        raise CheckpointError(f"{where}: expected a mapping, found {shown(data)}. {FETCH_AGAIN}")
    return data


def get_mapping(data: Mapping[str, Any], key: str, *, where: str) -> dict[str, Any]:
    """Return a field that is a mapping; an empty one if it is absent or null.

    Raises:
        CheckpointError: it is something else.
    """
    value = data.get(key)
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise wrong_type(where, key, "a mapping", value)
    return value


def get_text(data: Mapping[str, Any], key: str, *, where: str) -> str | None:
    """Return a field that is text; None if it is absent or null.

    Raises:
        CheckpointError: it is something else.
    """
    value = data.get(key)
    if value is not None and not isinstance(value, str):
        raise wrong_type(where, key, "text", value)
    return value


def get_count(data: Mapping[str, Any], key: str, *, maximum: int, where: str) -> int | None:
    """Return a field that counts something, from 1 to `maximum`; None if it is absent or null.

    Raises:
        CheckpointError: it is something else; true is no 1, and "4" no 4.
    """
    value = data.get(key)
    if value is not None and (type(value) is not int or not 1 <= value <= maximum):
        raise wrong_type(where, key, f"a whole number from 1 to {maximum:,}", value)
    return value


def get_texts(data: Mapping[str, Any], key: str, *, where: str) -> list[str]:
    """Return a field that is a list of texts; an empty one if it is absent or null.

    Raises:
        CheckpointError: it is something else.
    """
    value = data.get(key)
    if value is None:
        return []
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise wrong_type(where, key, "a list of texts", value)
    return value


def wrong_type(where: str, key: str, expected: str, value: object) -> CheckpointError:
    """Return the error for a field of another type."""
    kind = WORDS.get(type(value), type(value).__name__)
    return CheckpointError(
        f"{where}: {key!r:.100}: expected {expected}, found {shown(value)} ({kind}). {FETCH_AGAIN}"
    )


def _content(path: Path) -> bytes:
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):  # a pipe would never end
            kind = "a folder" if stat.S_ISDIR(found.st_mode) else "something else"
            raise CheckpointError(f"{path}: expected a JSON file, found {kind}. {FETCH_AGAIN}")
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as exc:  # ValueError: a null byte in the name
        raise CheckpointError(f"{path}: cannot be read as JSON ({exc}). {FETCH_AGAIN}") from exc
    if len(content) > MAX_BYTES:
        raise CheckpointError(
            f"{path}: expected JSON of at most {MAX_BYTES >> 20} MiB, found more. {FETCH_AGAIN}"
        )
    return content


def _damaged(where: str, found: str) -> CheckpointError:
    return CheckpointError(
        f"{where}: cannot be read as JSON: expected plain UTF-8 JSON, found {found}. {FETCH_AGAIN}"
    )
