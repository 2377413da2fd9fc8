"""What a person, a script or an enemy may write into a recipe."""

import copy
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml
from hypothesis import strategies as st

from vla_eval.errors import VlaEvalError

MAX_MESSAGE = 4000  # characters: the longest lists all fields and all tasks
REPOSITORY = Path(__file__).parents[2]
ODD_SCALARS = (
    *("", "~", "null", "true", "yes", ".nan", ".inf", "-.inf", "1.0e+999", "1e-3", "0x1f", "010", "1:30"),
    *("2024-01-01", "2024-99-99", "0000-00-00", "9" * 5000, str(2**63), str(2**32), "-1", "-0.0", "1_000"),
    *(
        "!!int x",
        "!!timestamp nope",
        "!!binary aGk=",
        "!!python/name:os.system",
        "! x",
        "!<tag:x> y",
        "&a *a",
    ),
    *('"\\0"', '"\\ud800"', '"\\UFFFFFFFF"', "'", '"', "*a", "&a", "<<", "=", "%", "@x", "`x", "|", ">", "-"),
    *(
        "..",
        "../x",
        "os:system",
        "__main__:x",
        "vla_eval.cli.main:main",
        "=cmd",
        "+1",
        "a\nb",
        "é",
        "\U0001f916",
    ),
)
FRAGMENTS = (
    *(
        ": ",
        "- ",
        "? ",
        ", ",
        "[",
        "]",
        "{",
        "}",
        "\n",
        "\n  ",
        "\t",
        "\r",
        "\0",
        "\ufeff",
        "#",
        "---\n",
        "...\n",
    ),
    *(
        "&a ",
        "*a",
        "<<: *a",
        "!!map ",
        "%YAML 1.1\n",
        "%YAML " + "9" * 5000,
        "[" * 200,
        "- " * 200,
        "{a: " * 99,
    ),
    *ODD_SCALARS,
)

plain = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.sampled_from([0, -1, 1, 2**31, 2**32, 2**63, 10**11, 10**18]),
        st.floats(),
        st.text(max_size=20),
        st.sampled_from(ODD_SCALARS),
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
"""Values of YAML, as a script would write them."""

yaml_text = st.lists(
    st.sampled_from(FRAGMENTS) | st.sampled_from(["name", "tasks", "env", "a", "1"]) | st.text(max_size=5),
    max_size=12,
).map("".join)
"""Text that looks like YAML more often than not."""


@functools.cache
def shipped(folder: str) -> tuple[str, ...]:
    """Return the text of every recipe of a folder."""
    return tuple(path.read_text(encoding="utf-8") for path in sorted((REPOSITORY / folder).glob("*.yaml")))


@functools.cache
def _shipped_data(folder: str) -> tuple[Any, ...]:  # Any: plain data
    return tuple(yaml.safe_load(text) for text in shipped(folder))


def _paths(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:  # Any: plain data
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    return [one for key, value in items for one in ((*path, key), *_paths(value, (*path, key)))]


@st.composite
def changed_recipe(draw: st.DrawFn, folder: str) -> str:
    """A shipped recipe in which one to three fields are changed, removed, renamed or added."""
    data = copy.deepcopy(draw(st.sampled_from(_shipped_data(folder))))
    for _ in range(draw(st.integers(1, 3))):
        *way, last = draw(st.sampled_from(_paths(data)))
        target = data
        for key in way:
            target = target[key]
        match draw(st.sampled_from(["change", "change", "remove", "rename", "add"])):
            case "remove":
                del target[last]
            case "rename" if isinstance(target, dict):
                target[draw(st.text(max_size=8) | st.sampled_from(ODD_SCALARS))] = target.pop(last)
            case "add" if isinstance(target, dict):
                target[draw(st.text(max_size=8))] = draw(plain)
            case _:
                target[last] = draw(plain)
        if not _paths(data):
            break
    return yaml.safe_dump(data, allow_unicode=draw(st.booleans()))


@st.composite
def damaged_text(draw: st.DrawFn, folder: str) -> str:
    """A shipped recipe with one to three places cut out or written over."""
    text = draw(st.sampled_from(shipped(folder)))
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(text)))
        end = min(len(text), start + draw(st.sampled_from([0, 0, 1, 2, 5, 20])))
        text = text[:start] + draw(st.sampled_from(FRAGMENTS) | st.text(max_size=3)) + text[end:]
    return text


def outcome[T](call: Callable[[], T]) -> T | None:
    """Return what comes of a call, or None where it is refused with one message; nothing else is allowed."""
    try:
        return call()
    except VlaEvalError as exc:
        message = str(exc)
        assert 10 < len(message) < MAX_MESSAGE, message
        assert " object at 0x" not in message
        assert "Traceback" not in message
        return None
