"""Turn plain data of YAML or JSON strictly into frozen dataclasses. Knows nothing of what the recipes mean.

Strict means: no unknown field, no field twice, no text where a list or a number is expected, no
`true` where a number is expected, no number that is infinite. A mistyped name or value is an error,
never a default. Not by pydantic: of a union it names the branches, not what the field may be, and every verb
would wait 0.15 s for it.
"""

import dataclasses
import functools
import logging
import math
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from vla_eval.errors import MAX_SHOWN, RecipeError, did_you_mean
from vla_eval.strict.bounds import MAX_DEPTH
from vla_eval.strict.json_text import WORDS, shown, wrong
from vla_eval.strict.renamed import FORMERLY
from vla_eval.strict.yaml_data import load_yaml as load_yaml

logger = logging.getLogger(__name__)

READ = "read"


def decode[T](cls: type[T], data: Mapping[str, Any], *, where: str) -> T:
    """Return plain data of YAML or JSON as an object of a frozen dataclass; messages name `where`."""
    try:
        decoded: T = _decoded(cls, data, path="")
    except RecipeError as exc:
        raise RecipeError(f"{where}: {exc}") from exc
    return decoded


def read_by(read: Callable[[Any], Any]) -> dict[str, Any]:  # Any: plain data, not yet checked
    """Return the metadata of a dataclass field that may be written in another way; `read` rewrites it."""
    return {READ: read}


def current_names(cls: type) -> dict[str, str]:
    """Return old name -> current name of the renamed fields of a dataclass."""
    fields = (field for field in dataclasses.fields(cls) if FORMERLY in field.metadata)
    return {field.metadata[FORMERLY]: field.name for field in fields}


def use_current_names(cls: type, data: dict[str, Any], *, prefix: str) -> None:
    """Give the renamed fields in the plain data of a dataclass their current names, in place."""
    for old, new in current_names(cls).items():
        if old not in data:
            continue
        if new in data:
            raise RecipeError(
                f"'{prefix}{old}' is the old name of '{prefix}{new}', and both are there. "
                f"Keep '{prefix}{new}'."
            )
        warn_renamed(f"'{prefix}{old}'", f"'{prefix}{new}'")
        data[new] = data.pop(old)


@functools.cache  # one warning per name and process
def warn_renamed(old: str, new: str) -> None:
    """Log that something has a new name."""
    logger.warning(
        "warning: %s is now called %s. The old name still works; please use the new one.", old, new
    )


def check_value(hint: Any, value: object, *, path: str) -> Any:  # Any: a type annotation, and such a value
    """Return the value as the annotation says, or raise `RecipeError`; `path` names it in the message."""
    return _decoded(hint, value, path=path)


def set_field(
    cls: type,
    data: dict[str, Any],
    path: str,
    value: Any,
    *,
    where: str,
    free: Mapping[str, Sequence[str]] = types.MappingProxyType({}),
) -> None:
    """Put a plain value at a dotted path (`chunking.mode`) of plain data, in place.

    In a mapping all names are free. `where` is the flag, for messages; `free` is name -> the paths that it
    may be meant for in such mappings. A field that the dataclass has not, or a part of the path that has no
    fields, is refused.
    """
    steps = _walk(cls, path, where=where, free=free)
    for step in steps[:-1]:
        _rename(step, data)
        if data.get(step.name) is None:  # not given, or given without a value
            data[step.name] = {}
        child = data[step.name]
        if not isinstance(child, dict):
            raise RecipeError(f"{where}: '{step.name}' is {shown(child)}, which has no fields.")
        data = child
    _rename(steps[-1], data)
    data[steps[-1].name] = value


class _Step(NamedTuple):
    """One name of a dotted path, the dataclass that has the field (None: a mapping), and what precedes it."""

    cls: type | None
    prefix: str
    name: str


def _walk(cls: type, path: str, *, where: str, free: Mapping[str, Sequence[str]]) -> list[_Step]:
    """Return the steps of a dotted path, by their current names; in a mapping all names are free."""
    current: Any = cls  # Any: a type annotation
    names = path.split(".")
    if len(names) > MAX_DEPTH:
        raise RecipeError(f"{where}: nested more than {MAX_DEPTH} deep.")
    steps: list[_Step] = []
    prefix = ""
    for index, name in enumerate(names):
        options = _options(current)
        found = next((option for option in options if _is_dataclass_type(option)), None)
        if found is None:
            if any(option is Any or get_origin(option) in (dict, Mapping) for option in options):
                return [*steps, *(_Step(None, "", free) for free in names[index:])]
            raise RecipeError(f"{where}: '{prefix[:-1]}' is {_describe(current)}, which has no fields.")
        hints = _hints(found)
        known = current_names(found).get(name, name)
        if known not in hints:
            within = [] if prefix else [*free.get(name, ()), *_fields_within(found, name)]
            raise RecipeError(f"{where}: {_no_such_field(f'{prefix}{name}', name, list(hints), within)}")
        if known != name:
            warn_renamed(f"'{prefix}{name}'", f"'{prefix}{known}'")
        steps.append(_Step(found, prefix, known))
        current, prefix = hints[known], f"{prefix}{known}."
    return steps


def _rename(step: _Step, data: dict[str, Any]) -> None:
    if step.cls is not None:
        use_current_names(step.cls, data, prefix=step.prefix)


def _decoded(hint: Any, value: Any, *, path: str) -> Any:  # Any: type annotations and plain data
    """Return the value as the annotation says: dataclasses, tuples for lists, floats; refuse the rest."""
    for option in _options(hint):
        origin = get_origin(option)
        if _is_dataclass_type(option) and isinstance(value, Mapping):
            return _decoded_fields(option, value, path=path)
        if origin in (tuple, Sequence) and isinstance(value, list | tuple):
            item_hint = get_args(option)[0]
            return tuple(_decoded(item_hint, item, path=f"{path}[{i}]") for i, item in enumerate(value))
        if origin is dict and isinstance(value, Mapping):
            item_hint = get_args(option)[1]
            return {key: _decoded(item_hint, item, path=f"{path}.{key!s:.60}") for key, item in value.items()}
        if option is float and type(value) in (int, float):
            return _finite(value, path=path)
        if option is Any:
            _check_plain(value, path=path, depth=0)
            return value
        if isinstance(option, type) and type(value) is option:
            return value
        if origin is Literal and value in get_args(option) and not isinstance(value, bool):
            return value
    raise RecipeError(_wrong(path, _describe(hint), value))


def _decoded_fields(cls: type, data: Mapping[str, Any], *, path: str) -> Any:  # Any: an object of `cls`
    hints = _hints(cls)
    prefix = f"{path}." if path else ""
    data = dict(data)
    use_current_names(cls, data, prefix=prefix)
    fields = [field for field in dataclasses.fields(cls) if field.init]
    for field in fields:
        if READ in field.metadata and field.name in data:
            data[field.name] = field.metadata[READ](data[field.name])
    for name in data:
        if name not in hints:
            raise RecipeError(_no_such_field(f"{prefix}{name}", name, [field.name for field in fields]))
    values = {name: _decoded(hints[name], value, path=f"{prefix}{name}") for name, value in data.items()}
    for field in fields:
        is_required = field.default is field.default_factory is dataclasses.MISSING
        if is_required and field.name not in values:
            raise RecipeError(f"the field '{prefix}{field.name}' is missing.")
    return cls(**values)


def _finite(value: float, *, path: str) -> float:
    try:
        number = float(value)
    except OverflowError:  # a whole number of more than 308 digits
        number = math.inf
    if not math.isfinite(number):
        raise RecipeError(f"'{path}': expected a finite number, found {shown(value)}.")
    return number


def _check_plain(value: object, *, path: str, depth: int) -> None:
    """Raise `RecipeError` unless this is what JSON can hold: free values are stored as JSON."""
    if depth > MAX_DEPTH:
        raise RecipeError(f"'{path.split('.')[0]}': nested more than {MAX_DEPTH} deep.")
    if isinstance(value, float):
        _finite(value, path=path)
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            _check_plain(item, path=f"{path}[{i}]", depth=depth + 1)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            _check_plain(item, path=f"{path}.{key!s:.60}", depth=depth + 1)
    elif value is not None and not isinstance(value, str | int):
        raise RecipeError(_wrong(path, "text, a number, a list or a mapping", value))


_hints = functools.cache(get_type_hints)


def _options(hint: Any) -> tuple[Any, ...]:  # Any: type annotations
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def _is_dataclass_type(hint: Any) -> bool:  # Any: a type annotation
    return isinstance(hint, type) and dataclasses.is_dataclass(hint)


def _no_such_field(path: str, name: str, known: list[str], within: Sequence[str] = ()) -> str:
    meant = f" Did you mean '{"' or '".join(within)}'?" if within else did_you_mean(name, known)
    return f"there is no field '{path:.{MAX_SHOWN}}'.{meant} Known: {', '.join(known)}."


def _fields_within(cls: type, name: str) -> list[str]:
    """Return the paths of the sections of a dataclass that have a field of this name."""
    sections = ((field, option) for field, hint in _hints(cls).items() for option in _options(hint))
    return [
        f"{field}.{name}"
        for field, option in sections
        if _is_dataclass_type(option) and name in _hints(option)
    ]


def _wrong(path: str, expected: str, value: object) -> str:
    hint = ""
    if expected.startswith("a list") and isinstance(value, str):
        hint = f" Write it in brackets: [{value:.80}]."
    elif "number" in expected and isinstance(value, str) and is_number(value):
        hint = " Write it without quotes or leading zeros, with a point and a sign in the exponent: 1.0e-3."
    return wrong(path, expected, value) + hint


def is_number(text: str) -> bool:
    """Whether Python reads a text as a number, blanks around it aside."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _describe(hint: Any) -> str:  # Any: a type annotation
    """Say in words what an annotation allows."""
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(_describe(option) for option in get_args(hint))
    if origin is Literal:
        return " or ".join(f"'{option}'" for option in get_args(hint))
    if origin in (tuple, Sequence):
        return f"a list, each entry {_describe(get_args(hint)[0])}"
    if origin is dict or _is_dataclass_type(hint):
        return "a mapping"
    return WORDS.get(hint, str(hint))
