"""The one reader of a checkpoint's JSON, which others wrote, and of fields of one type. No packages."""

import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any  # Any: JSON of another program

from vla_eval.errors import CheckpointError, RecipeError
from vla_eval.strict.decoding import check_value
from vla_eval.strict.json_text import WORDS as WORDS
from vla_eval.strict.json_text import loads, shown, wrong

MAX_BYTES = 64 << 20  # the largest that were seen hold statistics of dozens of datasets: under 1 MiB
FETCH_AGAIN = "Fetch the checkpoint again, from where you trust it."


def read_json(path: Path) -> dict[str, Any]:
    """Return the mapping of a JSON file; `CheckpointError` if it is missing, too large, or no such JSON."""
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
    return parse_json(content, where=str(path))


def parse_json(content: bytes, *, where: str) -> dict[str, Any]:
    """Return the mapping that the bytes of a JSON file hold, or raise `CheckpointError`."""
    try:
        data = loads(content)
    except ValueError as exc:  # json's and UTF-8's own are such errors
        found = f"expected plain UTF-8 JSON, found {exc}"
        raise CheckpointError(f"{where}: cannot be read as JSON: {found}. {FETCH_AGAIN}") from exc
    if not isinstance(data, dict):
        raise CheckpointError(f"{where}: expected a mapping, found {shown(data)}. {FETCH_AGAIN}")
    return data


def get_mapping(data: Mapping[str, Any], key: str, *, where: str) -> dict[str, Any]:
    """Return a field that is a mapping; an empty one if it is absent or null. Anything else is refused."""
    return _get(data, key, dict, where) or {}


def get_text(data: Mapping[str, Any], key: str, *, where: str) -> str | None:
    """Return a field that is text; None if it is absent or null. Anything else is refused."""
    found: str | None = _get(data, key, str, where)
    return found


def get_texts(data: Mapping[str, Any], key: str, *, where: str) -> list[str]:
    """Return a field that is a list of texts; an empty one if it is absent or null. Else it is refused."""
    return list(_get(data, key, tuple[str, ...], where) or ())


def get_count(data: Mapping[str, Any], key: str, *, maximum: int, where: str) -> int | None:
    """Return a field that counts something, from 1 to `maximum`; None if it is absent or null."""
    value = data.get(key)
    if value is not None and (type(value) is not int or not 1 <= value <= maximum):
        raise wrong_type(where, key, f"a whole number from 1 to {maximum:,}", value)
    return value


def _get(data: Mapping[str, Any], key: str, hint: Any, where: str) -> Any:  # Any: a type annotation, JSON
    value = data.get(key)
    try:
        return None if value is None else check_value(hint, value, path=key)
    except RecipeError as exc:
        raise CheckpointError(f"{where}: {exc} {FETCH_AGAIN}") from exc


def wrong_type(where: str, key: str, expected: str, value: object) -> CheckpointError:
    """Return the error for a field of another type."""
    return CheckpointError(f"{where}: {wrong(key, expected, value)} {FETCH_AGAIN}")
