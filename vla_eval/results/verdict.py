"""Say in sentences what a table shows: which policies beat chance. Computes no number."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from vla_eval.results.comparison import CHANCE_POLICY
from vla_eval.results.latex_preset import CONTROLS
from vla_eval.results.success_table import Row, Table

LEVEL = 0.05
SMALLEST_SAID_P = 0.001


class Verdict(NamedTuple):
    """What a table shows of one task.

    Attributes:
        task: its id.
        sentences: one per policy, the best first.
    """

    task: str
    sentences: tuple[str, ...]


def verdicts(table: Table) -> list[Verdict]:
    """Return the verdict on each task of a table, in its order.

    The scripted controls are no subject of a verdict, unless nothing else was run: then the oracle is.
    """
    found = []
    for task in dict.fromkeys(row.task for row in table.rows):
        rows = [row for row in table.rows if row.task == task]
        learned = [row for row in rows if row.policy not in CONTROLS]
        told = learned or [row for row in rows if row.policy == "oracle"]
        sentences = [_sentence(row, rows) for row in sorted(told, key=_rank)]
        if sentences:
            found.append(Verdict(task, tuple(sentences)))
    return found


def _rank(row: Row) -> tuple[float, float]:
    """Sort the best first, what is undefined last; ties stay in the order of the table."""
    values = (row.paired_difference, row.success_once)
    difference, success = (math.inf if value is None else -value for value in values)
    return difference, success


def _sentence(row: Row, rows: Sequence[Row]) -> str:
    name = _name(row, rows)
    if row.success_once is None:
        return f"{name} has no result yet."
    if row.baseline != CHANCE_POLICY or row.paired_difference is None or row.paired_p is None:
        known = "not measured" if row.chance is None else f"{row.chance:.2f} by arithmetic"
        return (
            f"{name} succeeds in {row.success_once:.2f} of its episodes. Chance is {known}: without "
            f"{CHANCE_POLICY} on the same episodes, nothing is said of memory{_choice(row)}."
        )
    difference = f"{row.paired_difference:+.2f} [{row.paired_low:+.2f}, {row.paired_high:+.2f}]"
    said = f"{difference}, {_p(row.paired_p)}{_choice(row)}"
    if row.paired_p >= LEVEL:
        return f"{name} is not shown to beat chance: {said}."
    return f"{name} {'beats chance by' if row.paired_difference > 0 else 'is worse than chance:'} {said}."


def _name(row: Row, rows: Sequence[Row]) -> str:
    """Return the policy, with its K and its settings if the same policy has other rows."""
    others = [other for other in rows if other.policy == row.policy]
    parts = [row.policy]
    if len({other.n_action_steps for other in others}) > 1:
        parts.append(f"K={row.n_action_steps}")
    if row.variant and len({other.variant for other in others}) > 1:
        parts.append(row.variant)
    return ", ".join(parts)


def _choice(row: Row) -> str:
    if row.n_chose_right is None:
        return ""
    return f"; first choice right in {row.n_chose_right} of {row.n_episodes}"


def _p(value: float) -> str:
    return f"p < {SMALLEST_SAID_P}" if value < SMALLEST_SAID_P else f"p = {value:.3f}"
