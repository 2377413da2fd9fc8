"""The one reader of a checkpoint's JSON, which somebody else wrote. Standard library only.

It returns plain data: text that is UTF-8, finite numbers, no key twice, and no nesting that later code
could not walk through. Whoever reads a field says which type it has, with the functions below.
"""

import json
import math
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn  # Any: JSON of another program

from vla_eval.errors import CheckpointError

MAX_BYTES = 64 << 20  # the largest that were seen hold statistics of dozens of datasets: under 1 MiB
MAX_DEPTH = 50  # configurations are about 5 deep; Python's own limit is 1,000 calls
MAX_SHOWN = 60
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
        data = json.loads(
            content.decode("utf-8"),
            object_pairs_hook=_without_repetition,
            parse_constant=_no_number,
            parse_float=_finite,
        )
        _check_nesting(data)
    except RecursionError as exc:
        raise _damaged(where, f"nesting of more than {MAX_DEPTH} levels") from exc
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


def shown(value: object) -> str:
    """Return the beginning of what was found, for messages."""
    text = repr(value) if not isinstance(value, int) or abs(value) < 10**MAX_SHOWN else "a very large number"
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"


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


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for name, value in pairs:
        if name in data:
            raise ValueError(f"the field {shown(name)} twice")
        data[name] = value
    return data


def _no_number(name: str) -> NoReturn:
    raise ValueError(f"{name}, which is no number of JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text:.{MAX_SHOWN}}, which no number can hold")
    return value


def _check_nesting(data: object) -> None:
    """Refuse deep nesting, and text that is no Unicode; without recursion."""
    level: list[object] = [data]
    for _ in range(MAX_DEPTH):
        below: list[object] = []
        for value in level:
            if isinstance(value, dict):
                below += (*value, *value.values())
            elif isinstance(value, list):
                below += value
            elif isinstance(value, str):
                value.encode("utf-8")  # half a surrogate pair cannot be printed, nor be a path
        if not below:
            return
        level = below
    raise RecursionError


def _damaged(where: str, found: str) -> CheckpointError:
    return CheckpointError(
        f"{where}: cannot be read as JSON: expected plain UTF-8 JSON, found {found}. {FETCH_AGAIN}"
    )
