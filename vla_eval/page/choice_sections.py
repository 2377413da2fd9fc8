"""The page's section on choices: targets, first choices and causes of failure."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from vla_eval.page.material import Material
from vla_eval.page.tables import Matrix, shaded
from vla_eval.results.choice_causes import MOVED_M, Cause, ChoiceReport, Kind, report_choices
from vla_eval.results.printed_table import UNDEFINED, Column, PrintedTable, cells_of
from vla_eval.results.success_table import Row
from vla_eval.tasks.objects.item_names import item_names


class Explanation(NamedTuple):
    """A cause, by its title, and the rule behind it."""

    title: str
    rule: str


EXPLANATIONS: dict[Cause, Explanation] = {
    "right": Explanation(
        "right choice",
        "the first candidate touched was right, and the episode succeeded (by memory or by luck)",
    ),
    "not_finished": Explanation(
        "right choice, not finished", "the first candidate touched was right, but the task was not completed"
    ),
    "wrong": Explanation("wrong choice", "a wrong candidate was touched first"),
    "position_habit": Explanation(
        "position habit", "a wrong candidate was touched first, at the place that wrong choices prefer"
    ),
    "never_chose": Explanation("never chose", "the arm moved but touched no candidate"),
    "could_not_move": Explanation(
        "could not move", f"the arm was never {MOVED_M * 100:.0f} cm from where it began"
    ),
}
KIND_NAMES: dict[Kind, str] = {"item": "item", "place": "place (0 is the robot's rightmost)"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """The choices of all rows with candidates; matrices by the row's name, and what the records lack."""

    explanations: tuple[Explanation, ...]
    table: PrintedTable
    missing: tuple[str, ...]
    matrices: dict[str, tuple[Matrix, ...]]


def choices(material: Material) -> Choices | None:
    """Return the choices behind the results; None if no row has candidates."""
    reports = [(row, report_choices(row.episodes)) for row in material.table.rows]
    found = [(row, report) for row, report in reports if report is not None]
    if not found:
        return None
    columns: list[Column[tuple[Row, ChoiceReport]]] = [
        Column("policy", lambda of: material.name_of(of[0], with_task=True), False),
        *(Column(title, partial(_n_episodes, cause)) for cause, (title, _) in EXPLANATIONS.items()),
        Column("habit of place", lambda of: _habit(of[1], "place", of[0].task), False),
        Column("habit of item", lambda of: _habit(of[1], "item", of[0].task), False),
    ]
    return Choices(
        explanations=tuple(EXPLANATIONS.values()),
        table=PrintedTable(columns=columns, rows=cells_of(columns, found)),
        missing=tuple(_missing([report for _, report in found])),
        matrices={
            material.name_of(row, with_task=True): tuple(
                _matrix(report, kind, row.task) for kind in KIND_NAMES if report.confusion[kind]
            )
            for row, report in found
        },
    )


def _missing(reports: list[ChoiceReport]) -> Iterator[str]:
    if not all(report.reach_is_known for report in reports):
        yield (
            "Some records (of an earlier version) do not say how far the arm moved. For them, “could not "
            "move” cannot be distinguished from “never chose”."
        )
    if any(not report.confusion["place"] and report.confusion["item"] for report in reports):
        yield "Some records do not say where the candidates were. For them, no habit of place can be found."
    if any(not report.confusion["item"] for report in reports):
        yield "If several candidates are right, there is no single target and no matrix."


def _n_episodes(cause: Cause, of: tuple[Row, ChoiceReport]) -> str:
    return str(of[1].causes[cause])


def _habit(report: ChoiceReport, kind: Kind, task: str) -> str:
    habit = report.habits[kind]
    if habit is None:
        return UNDEFINED
    if not habit.is_found:
        return f"not shown (p={habit.p_value:.2g})"
    share = f"{habit.n_chosen}/{habit.n_possible}"
    luck = f"{habit.by_luck:.2f} by luck, p={habit.p_value:.2g}"
    return f"{kind} {_names(report, kind, task)[habit.index]}: {share} of the wrong choices ({luck})"


def _names(report: ChoiceReport, kind: Kind, task: str) -> tuple[str, ...]:
    if kind != "item":
        return item_names("", report.n_candidates)
    return item_names(task, report.n_candidates, given=report.candidate_names)


def _matrix(report: ChoiceReport, kind: Kind, task: str) -> Matrix:
    counts = report.confusion[kind]
    names = _names(report, kind, task)
    chosen: list[int | None] = [*range(report.n_candidates), None]
    rows = [[counts.get((target, choice), 0) for choice in chosen] for target in range(report.n_candidates)]
    return Matrix(
        title=f"Episodes by {KIND_NAMES[kind]}: target (rows) and first choice (columns)",
        names=names,
        columns=tuple("none" if i is None else names[i] for i in chosen),
        rows=shaded(rows, lambda target, choice: target == choice),
    )
