"""Options that are also flags of a command: a dataclass's fields say how they are typed. Knows no command."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any  # values of options

YES_NO = {"yes": True, "no": False}


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Flag:
    """How a field is typed."""

    name: str  # of the flag
    settings: Mapping[str, Any]  # argparse's, its help among them
    values: Mapping[str, Any]  # what may be typed -> what it means; empty: what is typed is the value
    former: str = ""  # an earlier name of the flag


def option(
    default: Any, name: str, *, values: Mapping[str, Any] = {}, former: str = "", **settings: Any
) -> Any:
    """Return a field of a dataclass that is also a flag; see `Flag`."""
    flag = Flag(name=name, settings=settings, values=values, former=former)
    return dataclasses.field(default=default, metadata={"flag": flag})


def gripper_option() -> Any:
    """Return the field `gripper`: how the data of a published checkpoint encode it, which no file says."""
    names = "unit_open, unit_closed, maniskill or negated"
    return option(None, "--gripper", metavar="NAME", help=f"how its data encode it, has to be said: {names}")


def flags_of(options: type[Any]) -> dict[str, Flag]:
    """Return the flags of a class of options by the names of its fields."""
    found = {one.name: one.metadata.get("flag") for one in dataclasses.fields(options)}
    return {name: flag for name, flag in found.items() if flag is not None}


def typed(options: type[Any], given: Mapping[str, Any]) -> Iterable[str]:
    """Yield the words of a command that gives these options."""
    for name, flag in flags_of(options).items():
        if name in given:
            words = {meaning: word for word, meaning in flag.values.items()}
            yield from (flag.name, str(words.get(given[name], given[name])))
