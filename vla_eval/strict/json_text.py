"""Read JSON, and check it against the types of a dataclass. Knows nothing of what the values mean.

Strict means: no field twice, none unknown, none missing, no text where a number is expected, no number that
is not finite, no nesting without end. The reader says what to do about it. The text is read by `json`, as
pydantic's own parser accepts a field twice.
"""

import functools
import json
import math
from collections import Counter
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, cast  # Any: JSON

from vla_eval.errors import VlaEvalError
from vla_eval.plain_text import printable
from vla_eval.strict.bounds import MAX_DEPTH
from vla_eval.strict.bounds import Count as Count
from vla_eval.strict.bounds import Distance as Distance
from vla_eval.strict.bounds import Positive as Positive
from vla_eval.strict.bounds import Rate as Rate
from vla_eval.strict.bounds import Seconds as Seconds

if TYPE_CHECKING:
    from pydantic_core import SchemaValidator

TOO_DEEP = f"nesting of more than {MAX_DEPTH} levels"
MAX_SHOWN = 80  # characters of what was found


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Where JSON is from, for messages."""

    where: str  # file, and line where there are several
    what: str  # what is expected there, with its article: `an episode record`
    remedy: str  # what to do if it is something else; whole sentences
    error: type[VlaEvalError]

    def refuse(self, found: str, problem: object) -> VlaEvalError:
        """Build the error: what was expected, what was found, where, what to do next."""
        return self.error(f"{self.where}: expected {self.what}, found {found} ({problem}). {self.remedy}")


WORDS: Mapping[type, str] = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    list: "a list",
    tuple: "a list",
    dict: "a mapping",
    type(None): "nothing",
}


def read_json(text: str | bytes, source: Source, *, non_finite: bool = False) -> dict[str, Any]:  # Any: JSON
    """Return one JSON object, or refuse; numbers may be Python's NaN and Infinity if `non_finite`."""
    try:
        data = loads(text, lone_surrogates=True, non_finite=non_finite)
    except ValueError as exc:  # json's and UTF-8's own are such errors
        raise source.refuse(shown(text), shorten(str(exc))) from exc
    if not isinstance(data, dict):
        raise source.refuse(shown(text), "expected a mapping")
    return data


def read_version(data: dict[str, Any], name: str, known: int | tuple[int, ...], source: Source) -> None:
    """Take the format's version, a field of this name, out of JSON, or refuse any but the `known` ones."""
    if name not in data:
        raise source.refuse(f"no field '{name}'", "it is missing")
    version = data.pop(name)
    if type(version) is not int:
        raise source.refuse(f"{name} {shown(version)}", "expected a whole number")
    versions = (known,) if isinstance(known, int) else known
    if version not in versions:
        raise source.error(
            f"{source.where}: {name.replace('_', ' ')} {shown(version)}, this program reads "
            f"version {' and '.join(map(str, versions))}. "
            f"Use the version of mikasa-vla-eval that wrote it."
        )


def as_dataclass[T](cls: type[T], data: Any, source: Source) -> T:  # Any: JSON
    """Return JSON as an object of a dataclass whose annotations say what each field, also nested, may be."""
    import pydantic_core

    try:
        value: T = _validator(cast(Hashable, cls)).validate_python(data)
    except pydantic_core.ValidationError as exc:
        raise source.refuse(*_first_error(exc)) from exc
    return value


def read_file(path: Path, source: Source) -> bytes:
    """Return the content of a file; nothing else is opened, such as a pipe, which would never end."""
    try:
        if path.is_symlink() and not path.exists():
            raise OSError("a link to nothing, or to itself")
        if path.exists() and not path.is_file():
            raise OSError("a folder or a device, not a file")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise
    except OSError as exc:
        raise source.error(
            f"{source.where}: expected {source.what}, but it cannot be read ({exc.strerror or exc}). Check "
            f"what lies there and who may read it, or name another folder."
        ) from exc


def loads(content: str | bytes, *, lone_surrogates: bool = False, non_finite: bool = False) -> Any:
    """Return what JSON holds, or raise `ValueError`; text may hold lone surrogates, if asked."""
    text = content if isinstance(content, str) else content.decode("utf-8")
    try:
        data = (_NON_FINITE_DECODER if non_finite else _DECODER).decode(text)
    except RecursionError:
        raise ValueError(TOO_DEEP) from None  # its traceback is a thousand lines that say nothing
    if text.count("{") + text.count("[") > MAX_DEPTH:
        _check_nesting(data)
    if "\\u" in text and not lone_surrogates:
        json.dumps(data, ensure_ascii=False).encode("utf-8")
    return data


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:  # Any: JSON
    data = dict(pairs)
    if len(data) != len(pairs):
        counts = Counter(name for name, _ in pairs)
        raise ValueError(f"the field {shown(counts.most_common(1)[0][0])} twice")
    return data


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{shorten(text)}, which no number can hold")
    return value


def _no_number(name: str) -> NoReturn:
    raise ValueError(f"{name}, which is no number of JSON")


_DECODER = json.JSONDecoder(
    object_pairs_hook=_without_repetition, parse_float=_finite, parse_constant=_no_number
)
_NON_FINITE_DECODER = json.JSONDecoder(object_pairs_hook=_without_repetition)


def _check_nesting(data: object) -> None:
    """Refuse deep nesting; without recursion."""
    level = [data]
    for _ in range(MAX_DEPTH):
        below: list[object] = []
        for value in level:
            below += value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        level = [value for value in below if isinstance(value, dict | list)]
        if not level:
            return
    raise ValueError(TOO_DEEP)


STRICT_TYPES = frozenset({"int", "float", "bool"})


@functools.cache
def _validator(cls: Any) -> "SchemaValidator":
    """Return what checks the types of a dataclass: six times as fast as `decoding`, for files of records.

    pydantic's strict mode takes no mapping for a dataclass and no list for a tuple, which JSON has no other
    way to write. So it is the single values that are made strict here.
    """
    # Here and not above: `mikasa-vla --help` need not wait for it.
    import pydantic
    import pydantic_core

    schema: Any = pydantic.TypeAdapter(cls).core_schema  # Any: pydantic's own description, nested mappings
    return pydantic_core.SchemaValidator(_strict(schema))


def _strict(node: Any) -> Any:  # Any: a part of pydantic's description
    if isinstance(node, list | tuple):
        return type(node)(_strict(item) for item in node)
    if not isinstance(node, dict):
        return node
    kind = node.get("type")
    if kind == "str":  # text may hold a lone surrogate (a file name in a traceback), which pydantic refuses
        return {"type": "is-instance", "cls": str, "cls_repr": "text"}
    made = {name: value if name == "metadata" else _strict(value) for name, value in node.items()}
    if kind in STRICT_TYPES:
        made["strict"] = True
    if kind == "dataclass-args":
        made["extra_behavior"] = "forbid"
    return made


_EXPECTED = {
    **{f"{kind.__name__}_type": f"expected {WORDS[kind]}" for kind in (int, float, bool, dict, tuple)},
    **dict.fromkeys(("dataclass_type", "mapping_type"), f"expected {WORDS[dict]}"),
    "is_instance_of": f"expected {WORDS[str]}",
    "none_required": "expected null",
}


def _first_error(exc: Any) -> tuple[str, str]:  # Any: pydantic_core.ValidationError
    """Return what was found and what is wrong with it, of the first error."""
    error = exc.errors(include_url=False, include_context=False)[0]
    kind, place = error["type"], ".".join(str(part) for part in error["loc"])
    if kind in ("missing", "missing_argument", "missing_keyword_only_argument"):
        return f"no field '{shorten(place)}'", "it is missing"
    if kind in ("unexpected_keyword_argument", "extra_forbidden"):
        return f"the field '{shorten(place)}'", "there is no such field"
    problem = _EXPECTED.get(kind, error["msg"].replace("Input should be", "expected"))
    return f"{shorten(place)} {shown(error['input'])}", problem


def wrong(path: str, expected: str, value: object) -> str:
    """Return what is wrong with a value: what was expected, what was found, of which kind."""
    kind = WORDS.get(type(value), type(value).__name__)
    return f"'{path:.100}': expected {expected}, found {shown(value)} ({kind})."


def shown(value: object) -> str:
    """Return the beginning of what was found, in one printable line, for messages."""
    if isinstance(value, int) and abs(value) >= 10**MAX_SHOWN:  # Python refuses to print the largest
        return "a very large number"
    return shorten(repr(value[: MAX_SHOWN + 1]) if isinstance(value, str | bytes) else repr(value))


def shorten(text: str) -> str:
    """Return the beginning of a text, in one printable line."""
    return printable(text[:MAX_SHOWN]) + ("…" if len(text) > MAX_SHOWN else "")
