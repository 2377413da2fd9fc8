"""Values that no argument was made for, and the command lines that have them, made from the parsers."""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from vla_eval.cli.main import build_parser

LONG = "x" * 5_000
# The last can be made by nobody, not even by root, who would leave a folder to other tests.
TEXTS = ("a\0b", LONG, f"{LONG}/y", "d/" * 2_500, "\udcff\udcfe", "/dev/null/\udcff")
NUMBERS = ("-1", "1e3", "9" * 20, "9" * 5_000, "-" + "9" * 30, "1\0", "\udcff", "x", "")
SEEDS = ("1-" + "9" * 20, "1-1" + "0" * 30, "1-4294967295", "-5", "5-1", "-", "1-2-3", "1-" + "9" * 5_000)
OVERRIDES = (
    *("name=" + LONG, LONG + "=1", f"{LONG}.{LONG}=1", "=", "=1", "x", "\udcff=1", "name=\udcff"),
    *("name=a\0b", 'name="a\\0b"', 'name="\\ud800"', "name=" + "[" * 5_000, "a." * 2_500 + "b=1"),
    "name=" + "9" * 5_000,
)


class Case(NamedTuple):
    """A command line, and the value in it."""

    argv: list[str]
    hostile: str


def parsers(
    parser: argparse.ArgumentParser, above: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], argparse.ArgumentParser]]:
    """Yield the words and the parser of each verb, and of each action of those that have some."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield from parsers(below, (*above, name))
            return
    yield above, parser


def values_for(action: argparse.Action) -> tuple[str, ...]:
    """Return what to give to an argument."""
    if action.dest == "overrides":
        return OVERRIDES
    if action.dest == "seeds":
        return (*SEEDS, *NUMBERS)
    is_text = action.type in (None, str, Path)
    return TEXTS if is_text else (*NUMBERS, *TEXTS[:3])


def cases(verb: tuple[str, ...], needed: Sequence[str]) -> Iterator[Case]:
    """Yield a command line per argument of a verb and value; `needed` is what else the verb asks for."""
    n_before = 0  # positional arguments
    for action in dict(parsers(build_parser()))[verb]._actions:
        if action.nargs == 0:
            continue
        for value in values_for(action):
            if action.option_strings:
                yield Case([*verb, *needed, f"{action.option_strings[-1]}={value}"], value)
            elif not value.startswith("-"):
                yield Case([*verb, *needed[:n_before], value, *needed[n_before + 1 :]], value)
        n_before += not action.option_strings
