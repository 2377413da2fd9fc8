"""Which rows of a table may be ranked against each other, and why others may not."""

from collections.abc import Iterable, Mapping, Sequence

from vla_eval.errors import some_of
from vla_eval.results.passport.fields import SETTINGS, Field
from vla_eval.results.passport.passport import Passport, classes

DOCS = "docs/"
NOT_RANKED = "not ranked against each other"
APART = "apart"  # a row that may be ranked with no other one


def not_ranked(rows: Mapping[str, Sequence[Passport]]) -> list[str]:
    """Return notes on rows of a task that differ in a setting, and on what each setting does to success.

    Args:
        rows: task -> the passports of its rows that would be ranked.
    """
    tasks_of: dict[tuple[str, ...], list[str]] = {}
    named: dict[str, None] = {}
    for task, own in rows.items():
        firsts = [group[0] for group in classes(own)]
        differing = [
            one for i, one in enumerate(SETTINGS) if len({first.standing[i] for first in firsts}) > 1
        ]
        if differing:
            named |= dict.fromkeys(one.name for one in differing)
            tasks_of.setdefault(tuple(_named(one, firsts) for one in differing), []).append(task)
    notes = [
        f"{NOT_RANKED}: rows of {some_of(tasks)} that differ in {listed(parts)}."
        for parts, tasks in tasks_of.items()
    ]
    return [*notes, *(effect_of(one) for one in SETTINGS if one.name in named)]


def effect_of(field: Field) -> str:
    """Return a sentence on what a difference in a field does to success, and where that was measured."""
    page = "" if field.page is None else f" ({DOCS}{field.page})"
    return f"{field.words}: {field.effect}{page}."


def standing_letters(passports: Sequence[Passport]) -> list[str]:
    """Return for each figure the letter of those it may be ranked with; empty where it stands alone."""
    groups = [group for group in classes(passports) if len(group) > 1]
    letter_of = {one.standing: chr(ord("A") + number) for number, (one, *_) in enumerate(groups)}
    return [letter_of.get(one.standing, "") for one in passports]


def _named(field: Field, firsts: Iterable[Passport]) -> str:
    return f"{field.words} ({'; '.join(dict.fromkeys(one.text(field.name) for one in firsts))})"


def listed(parts: Sequence[str]) -> str:
    """Return `K`, or `image size, horizon and K`; there is at least one."""
    *before, last = parts
    return f"{', '.join(before)} and {last}" if before else last
