"""Read YAML strictly and turn it into frozen dataclasses. Knows nothing of what the recipes mean.

Strict means: no unknown field, no field twice, no text where a list or a number is expected, no
`true` where a number is expected. What a person mistyped is an error that says so, never a default.
"""

import dataclasses
import types
from collections.abc import Hashable, Mapping
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import dacite
import yaml

from vla_eval.errors import RecipeError, did_you_mean


class _StrictLoader(yaml.SafeLoader):
    """Refuses a key that is given twice: the second would silently win."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Build a mapping whose keys are all different."""
        seen: set[Any] = set()  # Any: a YAML key may be of any type
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                problem = f"found the key {key!r}, expected text (write it in quotes)"
                raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
            if key in seen:
                problem = f"the field '{key}' is given twice"
                raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


def load_yaml(text: str, *, where: str) -> Any:  # Any: whatever the YAML holds
    """Read YAML; no field may be given twice.

    Raises:
        RecipeError: it is no YAML; the message has line and column.
    """
    try:
        return yaml.load(text, Loader=_StrictLoader)  # a SafeLoader
    except yaml.MarkedYAMLError as exc:
        mark = exc.problem_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise RecipeError(f"{where}: {place}{exc.problem or exc}.") from exc
    except yaml.YAMLError as exc:
        raise RecipeError(f"{where}: not YAML: {exc}") from exc


def decode[T](cls: type[T], data: Mapping[str, Any], *, where: str) -> T:
    """Return `data` as an object of the dataclass.

    Args:
        cls: a frozen dataclass.
        data: what the YAML holds.
        where: the file, for messages.

    Raises:
        RecipeError: unknown or missing field, wrong type, or a value that the dataclass refuses.
    """
    try:
        return dacite.from_dict(cls, _prepared(cls, data, path=""), dacite.Config(strict=True))
    except dacite.MissingValueError as exc:
        raise RecipeError(f"{where}: the field '{exc.field_path}' is missing.") from exc
    except dacite.WrongTypeError as exc:
        expected = _describe(exc.field_type)
        raise RecipeError(f"{where}: {_wrong(exc.field_path or '', expected, exc.value)}") from exc
    except RecipeError as exc:
        raise RecipeError(f"{where}: {exc}") from exc


def find_field(cls: type, path: str, *, where: str) -> None:
    """Raise `RecipeError` unless the dataclass has a field at this dotted path; in a mapping all is free."""
    current: Any = cls  # Any: a type annotation
    walked = ""
    for name in path.split("."):
        if not _is_dataclass_type(current):
            if get_origin(current) in (dict, Mapping):
                return
            raise RecipeError(f"{where}: '{walked}' is {_describe(current)}, which has no fields.")
        hints = get_type_hints(current)
        walked = f"{walked}.{name}" if walked else name
        if name not in hints:
            raise RecipeError(f"{where}: {_no_such_field(walked, name, list(hints))}")
        current = hints[name]


def _prepared(hint: Any, value: Any, *, path: str) -> Any:  # Any: type annotations and YAML values
    """Turn lists into tuples and whole numbers into floats where the annotation says so; refuse the rest."""
    for option in _options(hint):
        if _is_dataclass_type(option) and isinstance(value, Mapping):
            return _prepared_fields(option, value, path=path)
        if get_origin(option) is tuple and isinstance(value, list):
            item_hint = get_args(option)[0]
            return tuple(_prepared(item_hint, item, path=f"{path}[{i}]") for i, item in enumerate(value))
        if get_origin(option) is dict and isinstance(value, Mapping):
            item_hint = get_args(option)[1]
            return {key: _prepared(item_hint, item, path=f"{path}.{key}") for key, item in value.items()}
        if option is float and isinstance(value, int) and not isinstance(value, bool):
            return float(value)
        if option is Any or (isinstance(option, type) and type(value) is option):
            return value
        if get_origin(option) is Literal and value in get_args(option) and not isinstance(value, bool):
            return value
    raise RecipeError(_wrong(path, _describe(hint), value))


def _prepared_fields(cls: type, data: Mapping[str, Any], *, path: str) -> dict[str, Any]:
    hints = get_type_hints(cls)
    prefix = f"{path}." if path else ""
    for name in data:
        if name not in hints:
            raise RecipeError(
                _no_such_field(f"{prefix}{name}", name, [f.name for f in dataclasses.fields(cls)])
            )
    return {name: _prepared(hints[name], value, path=f"{prefix}{name}") for name, value in data.items()}


def _options(hint: Any) -> tuple[Any, ...]:  # Any: type annotations
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def _is_dataclass_type(hint: Any) -> bool:  # Any: a type annotation
    return isinstance(hint, type) and dataclasses.is_dataclass(hint)


def _no_such_field(path: str, name: str, known: list[str]) -> str:
    return f"there is no field '{path}'.{did_you_mean(name, known)} Known: {', '.join(known)}."


def _wrong(path: str, expected: str, value: object) -> str:
    hint = ""
    if expected.startswith("a list") and isinstance(value, str):
        hint = f" Write it in brackets: [{value}]."
    elif "number" in expected and isinstance(value, str) and _reads_as_number(value):
        hint = " Write it without quotes, and with a point and a sign in the exponent: 1.0e-3."
    found = _TYPE_WORDS.get(type(value), "something else")
    return f"'{path}': expected {expected}, found {value!r} ({found}).{hint}"


def _reads_as_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


_TYPE_WORDS: dict[type, str] = {
    str: "text",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    dict: "a mapping",
    list: "a list",
    tuple: "a list",
    type(None): "nothing",
}


def _describe(hint: Any) -> str:  # Any: a type annotation
    """Say in words what an annotation allows."""
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(_describe(option) for option in get_args(hint))
    if origin is Literal:
        return " or ".join(f"'{option}'" for option in get_args(hint))
    if origin is tuple:
        return f"a list, each entry {_describe(get_args(hint)[0])}"
    if origin is dict or _is_dataclass_type(hint):
        return "a mapping"
    return _TYPE_WORDS.get(hint, str(hint))
