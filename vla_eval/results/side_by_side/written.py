"""Two passports beside each other: what differs, and what that may do to the figures."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import NamedTuple

from vla_eval.errors import ReportError
from vla_eval.results.formats import Format
from vla_eval.results.grouping import Grouping, RowEpisodes, group_runs
from vla_eval.results.passport.fields import FIELDS, Field
from vla_eval.results.passport.passport import UNKNOWN, Difference, Passport, differences, merged
from vla_eval.results.passport.ranking import effect_of, listed
from vla_eval.results.printed_table import Column, PrintedTable, cells_of, csv_text, write_tables
from vla_eval.results.side_by_side.of_row import horizon_of, passports_of
from vla_eval.storage.run_folder import StoredRun

JSON_VERSION = 1
AGREE = "They agree in every setting that affects success: they may be ranked."


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """What is compared: a passport and, of a run folder, its episodes."""

    passport: Passport
    grouping: Grouping | None = None

    @property
    def tasks(self) -> frozenset[str]:
        """The tasks of a run folder, without a namespace, as published results name them."""
        groups = {} if self.grouping is None else self.grouping.groups
        return frozenset(key.task.rpartition("/")[2] for key in groups)


def figure_of_run(run: StoredRun) -> Figure:
    """Return a run folder's figures as one; what differs between its rows has several values.

    Raises:
        ReportError: there is no episode yet.
    """
    grouping = group_runs([run])
    found = list(passports_of(grouping).values())
    if not found:
        raise ReportError(f"{run.path}: there is no episode yet. Run one with `mikasa-vla eval`.")
    return Figure(passport=merged(found, subject=str(run.path)), grouping=grouping)


class Rendered(NamedTuple):
    """Passports as text, without a newline at its end, and the notes, for which CSV has no place."""

    text: str
    notes: Sequence[str]


def render_passports(figures: Sequence[Figure], fmt: Format) -> Rendered:
    """Write one passport, or two with what differs."""
    passports = [one.passport for one in figures]
    found = differences(*passports) if len(passports) == 2 else ()
    notes = list(_notes(figures, found)) if len(passports) == 2 else []
    if fmt == "json":
        data = {
            "format_version": JSON_VERSION,
            "passports": [{"subject": one.subject, **one.to_dict()} for one in passports],
            "differences": [
                {"field": one.field.name, "kind": one.field.kind, "is_known": one.is_known} for one in found
            ],
            "notes": notes,
        }
        return Rendered(json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False), notes)
    table = passport_table(passports, found, notes)
    if fmt == "csv":
        rows = [dict(zip(table.titles, row, strict=True)) for row in table.rows]
        return Rendered(csv_text(table.titles, rows), notes)
    return Rendered(write_tables([table], fmt), notes)


def passport_table(
    passports: Sequence[Passport], found: Sequence[Difference] = (), notes: Sequence[str] = ()
) -> PrintedTable:
    """Return a row per field, and a column per passport; of two, also whether they agree but for `found`."""
    marks = {one.field.name: "differs" if one.is_known else UNKNOWN for one in found}
    columns: list[Column[Field]] = [Column("field", lambda one: one.words, is_number=False)]
    for number, passport in enumerate(passports):
        # The same folder may be given twice, and a title is a key in CSV.
        is_again = passport.subject in [one.subject for one in passports[:number]]
        title = f"{passport.subject} (again)" if is_again else passport.subject
        columns.append(Column(title, partial(_cell, passport), is_number=False))
    if len(passports) == 2:
        columns.append(Column("same?", lambda one: marks.get(one.name, "yes"), is_number=False))
    shown = [one for one in FIELDS if any(_says(of, one) for of in passports)]
    return PrintedTable(columns=columns, rows=cells_of(columns, shown), notes=notes)


def _cell(passport: Passport, field: Field) -> str:
    return passport.text(field.name)


def _says(passport: Passport, field: Field) -> bool:
    """Whether a field is worth a line: a setting always, others if they have a value."""
    return field.kind == "setting" or any(value is not None for value in passport.values[field.name])


def _notes(figures: Sequence[Figure], found: Sequence[Difference]) -> Iterator[str]:
    settings = [one for one in found if one.field.kind == "setting"]
    differ = [one.field.words for one in settings if one.is_known]
    unknown = [one.field.words for one in settings if not one.is_known]
    if not settings:
        yield AGREE
    if differ:
        yield f"Not to be ranked: {listed(differ)} differ{'s' * (len(differ) == 1)}."
    if unknown:
        yield f"Not to be ranked: not known of one or both: {listed(unknown)}."
    yield from (effect_of(one.field) for one in settings if one.is_known)
    first, second = figures
    if first.grouping is not None and second.grouping is not None:
        yield from _within_the_shorter(first.grouping, second.grouping)
        yield _common_seeds(first.grouping, second.grouping)
    environment = [one.field.words for one in found if one.field.kind == "environment" and one.is_known]
    if environment:
        yield f"Made in different environments ({listed(environment)}): what that does was not measured."


def _within_the_shorter(first: Grouping, second: Grouping) -> list[str]:
    """Say how many successes of the longer episodes fall into the shorter ones, from the records."""
    found: dict[str, None] = {}
    for (key, group), (other_key, other) in product(first.groups.items(), second.groups.items()):
        if (key.task, key.policy) != (other_key.task, other_key.policy):
            continue
        steps = (
            horizon_of(first.folders[key][0], key.task),
            horizon_of(second.folders[other_key][0], key.task),
        )
        if steps[0] is None or steps[1] is None or steps[0] == steps[1]:
            continue
        longer = group if steps[0] > steps[1] else other
        found[_cut(longer, min(steps[0], steps[1]))] = None
    return list(found)


def _cut(group: RowEpisodes, n_steps: int) -> str:
    results = group.results
    n_won = sum(one.outcome == "success" for one in results)
    n_early = sum(one.success_step is not None and one.success_step <= n_steps for one in results)
    return (
        f"{group.key} succeeds in {n_won} of {len(results)} episodes, and in {n_early} within the {n_steps} "
        "control steps that the other has."
    )


def _common_seeds(first: Grouping, second: Grouping) -> str:
    seeds = [
        {seed for group in grouping.groups.values() for run in group.runs for seed in run.records}
        for grouping in (first, second)
    ]
    return f"{len(seeds[0] & seeds[1])} seeds in common, of {len(seeds[0])} and {len(seeds[1])}."
