"""Read YAML as plain data: text, numbers, true and false, nothing, lists, mappings. Knows nothing of recipes.

Only PyYAML's parser is used. What it finds is turned into data here, so that no file can name a type, and so
that depth, number of values and size are bounded before anything is built. Words that YAML 1.1 alone takes
for dates or numbers (`2024-01-01`, `010`, `1:30`) are text.
"""

import re
from typing import Any, NoReturn

import yaml
from yaml.reader import Reader

from vla_eval.errors import MAX_SHOWN, RecipeError
from vla_eval.strict.bounds import MAX_DEPTH

_Event = Any  # Any: PyYAML's stubs do not say which fields an event has
_Mark = Any

MAX_CHARACTERS = 1_000_000  # of a file, and of all its texts once aliases stand for what they name
MAX_VALUES = 50_000  # some hundred times the longest recipe
MAX_DIGITS = 19  # of a 64-bit number
INT_RANGE = range(-(2**63), 2**63)

_WORDS: dict[str, bool | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **{form: True for word in ("true", "yes", "on") for form in (word, word.title(), word.upper())},
    **{form: False for word in ("false", "no", "off") for form in (word, word.title(), word.upper())},
}
_WHOLE = re.compile(r"[-+]?(0|[1-9][0-9_]*)")
_NUMBER = re.compile(
    r"[-+]?([0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*)([eE][-+][0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
)


def load_yaml(text: str, *, where: str) -> Any:  # Any: whatever the YAML holds
    """Read YAML; no field may be given twice, and infinite numbers are left to `decode`."""
    if len(text) > MAX_CHARACTERS:
        raise RecipeError(f"{where}: found more than {MAX_CHARACTERS} characters; a recipe is a short text.")
    reader = _Reader(text)
    try:
        return reader.document()
    except _RefusedError as exc:
        raise RecipeError(f"{where}: {_place(exc.mark)}: {exc}.") from exc
    except yaml.reader.ReaderError as exc:
        before = text[: exc.position]
        place = f"line {before.count('\n') + 1}, column {len(before) - before.rfind('\n')}"
        problem = f"found the character #x{exc.character:04x}, expected text"
        raise RecipeError(f"{where}: {place}: {problem}.") from exc
    except yaml.MarkedYAMLError as exc:
        place = _place(exc.problem_mark or reader.mark)
        raise RecipeError(f"{where}: {place}: {exc.problem or exc!s:.300}.") from exc
    except (yaml.YAMLError, ValueError, OverflowError) as exc:  # a \U or a %YAML with an impossible number
        raise RecipeError(f"{where}: {_place(reader.mark)}: not YAML: {exc!s:.200}.") from exc


class _RefusedError(Exception):
    """YAML that is not plain data."""

    def __init__(self, problem: str, mark: _Mark) -> None:
        super().__init__(problem)
        self.mark = mark


class _Reader:
    """Builds data from the events of PyYAML's parser."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._n_values = self._n_characters = 0
        self._anchored: dict[str, Any] = {}  # Any: plain data
        self._double: _RefusedError | None = None  # of no interest unless the text is YAML to its end
        self.mark: _Mark = None  # where the parser has come to

    def document(self) -> Any:  # Any: plain data
        self._events = yaml.parse(self._text, Loader=yaml.SafeLoader)
        self._next()  # the stream begins
        if isinstance(self._next(), yaml.StreamEndEvent):
            return None
        value = self._value(self._next(), depth=0)
        self._next()  # the document ends
        event = self._next()
        if not isinstance(event, yaml.StreamEndEvent):
            self._refuse("found '---', expected one document", event)
        if self._double is not None:
            raise self._double
        return value

    def _next(self) -> _Event:
        event = next(self._events)
        self.mark = event.end_mark
        return event

    def _value(self, event: _Event, *, depth: int) -> Any:  # Any: plain data
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self._anchored:
                name = str(event.anchor)[:MAX_SHOWN]
                self._refuse(f"found '*{name}' inside of '&{name}' itself, or without it before", event)
            return self._copy(self._anchored[event.anchor], event, depth)
        if event.tag is not None:
            self._refuse(f"found the tag '{event.tag:.{MAX_SHOWN}}', expected plain data", event)
        self._admit(event, depth)
        self._anchored.pop(event.anchor, None)  # until its end, it would stand for itself
        value = self._content(event, depth)
        if event.anchor is not None:
            self._anchored[event.anchor] = value
        return value

    def _content(self, event: _Event, depth: int) -> Any:  # Any: plain data
        if isinstance(event, yaml.ScalarEvent):
            text: str = event.value
            self._n_characters += len(text)
            if Reader.NON_PRINTABLE.search(text):
                self._refuse("found a control character or half a character, expected text", event)
            if event.style is not None:  # in quotes, or a block
                return text
            if text in _WORDS:
                return _WORDS[text]
            if _WHOLE.fullmatch(text):
                return self._whole_number(event, text.replace("_", ""))
            return _number(text) if _NUMBER.fullmatch(text) else text
        if isinstance(event, yaml.SequenceStartEvent):
            items = []
            while not isinstance(event := self._next(), yaml.SequenceEndEvent):
                items.append(self._value(event, depth=depth + 1))
            return items
        fields: dict[str, Any] = {}  # Any: plain data
        while not isinstance(event := self._next(), yaml.MappingEndEvent):
            name = self._name(event)
            if name in fields:
                problem = f"the field '{name:.{MAX_SHOWN}}' is given twice"
                self._double = self._double or _RefusedError(problem, event.start_mark)
            fields[name] = self._value(self._next(), depth=depth + 1)
        return fields

    def _name(self, event: _Event) -> str:
        if not isinstance(event, yaml.ScalarEvent):
            self._refuse("found a key that is a list, a mapping or an alias, expected text", event)
        name = self._value(event, depth=0)
        if not isinstance(name, str):
            self._refuse(f"found the key {name!r}, expected text (write it in quotes)", event)
        return name

    def _whole_number(self, event: _Event, text: str) -> int:
        n_digits = len(text.lstrip("+-"))
        if n_digits > MAX_DIGITS or int(text) not in INT_RANGE:
            self._refuse(f"found a whole number of {n_digits} digits, expected one of at most 64 bits", event)
        return int(text)

    def _copy(self, value: Any, event: _Event, depth: int) -> Any:  # Any: plain data
        """Return what an alias stands for, as an object of its own, within the bounds."""
        self._admit(event, depth)
        if isinstance(value, list):
            return [self._copy(item, event, depth + 1) for item in value]
        if isinstance(value, dict):
            self._n_characters += sum(map(len, value))
            return {name: self._copy(item, event, depth + 1) for name, item in value.items()}
        self._n_characters += len(value) if isinstance(value, str) else 0
        return value

    def _admit(self, event: _Event, depth: int) -> None:
        self._n_values += 1
        if depth > MAX_DEPTH:
            self._refuse(f"nested more than {MAX_DEPTH} deep", event)
        if self._n_values > MAX_VALUES:
            self._refuse(f"found more than {MAX_VALUES} values; a recipe is a short text", event)
        if self._n_characters > MAX_CHARACTERS:
            self._refuse(f"found more than {MAX_CHARACTERS} characters; a recipe is a short text", event)

    def _refuse(self, problem: str, event: _Event) -> NoReturn:
        raise _RefusedError(problem, event.start_mark)


def _number(text: str) -> float:
    is_finite = text[-1].isdigit() or text[-1] in "._"
    return float(text.replace("_", "") if is_finite else text.replace(".", ""))  # `.inf` is Python's `inf`


def _place(mark: _Mark) -> str:
    return f"line {mark.line + 1}, column {mark.column + 1}" if mark else "line 1, column 1"
