"""Say in sentences what a table shows: which policies beat chance. Computes no number."""

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

from vla_eval.results.comparison import CHANCE_POLICY
from vla_eval.results.estimates import LEVEL
from vla_eval.results.latex_preset import CONTROLS
from vla_eval.results.own_statistics import CHOICES, EPISODES, SUCCESS
from vla_eval.results.relative_statistics import CHANCE, PAIRED, SMALLEST_SHOWN_P, against_chance
from vla_eval.results.success_table import Row, Table
from vla_eval.tasks.catalog import find_task

Finding = Literal["no result", "chance unknown", "beats", "not shown", "worse"]

VERBS: Mapping[Finding, str] = {
    "beats": "beats chance",
    "not shown": "is not shown to beat chance",
    "worse": "is worse than chance",
}


class Verdict(NamedTuple):
    """What a table shows of one task."""

    task: str
    # of rows with the same settings the best first; one for all n_action_steps of a policy at which the
    # same was found
    sentences: tuple[str, ...]
    is_compared: bool  # whether any policy was compared with chance


def verdicts(table: Table) -> list[Verdict]:
    """Return the verdict on each task, in the table's order; the oracle's if only controls were run."""
    found = []
    for task in dict.fromkeys(row.task for row in table.rows):
        spec = find_task(task)
        if spec is not None and spec.is_base:
            continue  # chance is of choices of an arm; `audit --suite mikasa_base` says what needs memory
        rows = [row for row in table.rows if row.task == task]
        learned = [row for row in rows if row.policy not in CONTROLS]
        told = learned or [row for row in rows if row.policy == "oracle"]
        groups: dict[object, list[Row]] = {}
        for row in _best_first(told, table):
            finding = _finding(row)
            key = (row.policy, row.variant, finding, None if finding in VERBS else row.n_action_steps)
            groups.setdefault(key, []).append(row)
        sentences = [_sentence(sorted(group, key=_rank), rows) for group in groups.values()]
        if any(_finding(row) == "chance unknown" for row in told):
            sentences.append(_unknown_chance(told))
        if sentences:
            found.append(Verdict(task, tuple(sentences), any(_finding(row) in VERBS for row in told)))
    return found


def _best_first(rows: Sequence[Row], table: Table) -> list[Row]:
    """Sort rows with the same settings by what they show; others keep the order of the table."""
    alike: dict[object, list[Row]] = {}
    for row in rows:
        alike.setdefault(table.passports[row.key].standing, []).append(row)
    return [row for group in alike.values() for row in sorted(group, key=_rank)]


def _rank(row: Row) -> tuple[float, float]:
    """Sort the best first, what is undefined last; ties stay in the order of the table."""
    first = row[PAIRED][0] if row[PAIRED] else None
    values = (first.test.difference if first else None, row[SUCCESS].success_once)
    difference, success = (math.inf if value is None else -value for value in values)
    return difference, success


def _finding(row: Row) -> Finding:
    if row[SUCCESS].success_once is None:
        return "no result"
    compared = against_chance(row)
    if compared is None:
        return "chance unknown"
    if compared.corrected_p >= LEVEL:
        return "not shown"
    return "beats" if compared.test.difference > 0 else "worse"


def _sentence(group: Sequence[Row], rows: Sequence[Row]) -> str:
    """Return the finding on a policy at one or several K; the group has the largest difference first."""
    name, finding, row = _name(group, rows), _finding(group[0]), group[0]
    if finding == "no result":
        return f"{name} has no result yet."
    if finding == "chance unknown":
        return f"{name} succeeds in {row[SUCCESS].success_once:.2f} of its episodes{_choice(row)}."
    verb = VERBS[finding]
    if len(group) == 1:
        return f"{name} {verb}{' by' if finding == 'beats' else ':'} {_said(row)}."
    which, row = ("smallest", group[-1]) if finding == "beats" else ("largest", group[0])
    steps = _listed(sorted(one.n_action_steps for one in group))
    return (
        f"{name} {verb} at K = {steps}; the {which} difference, at K = {row.n_action_steps}, is {_said(row)}."
    )


def _unknown_chance(rows: Sequence[Row]) -> str:
    """Say once why some or all rows of a task were not compared with chance."""
    unknown = [row for row in rows if _finding(row) == "chance unknown"]
    compared = any(_finding(row) in VERBS for row in rows)
    steps = sorted({row.n_action_steps for row in unknown})
    which = f" at K = {_listed(steps)}" if compared else ""
    chance = unknown[0][CHANCE]
    known = "not measured" if chance is None else f"{chance.rate:.2f} by arithmetic"
    return (
        f"Chance{which} is {known}: without {CHANCE_POLICY} on the same episodes, nothing is said of memory."
    )


def _said(row: Row) -> str:
    compared = against_chance(row)
    assert compared is not None  # as in every row whose chance was measured
    test = compared.test
    difference = f"{test.difference:+.2f} [{test.interval.low:+.2f}, {test.interval.high:+.2f}]"
    p = compared.corrected_p
    said = f"p < {SMALLEST_SHOWN_P}" if p < SMALLEST_SHOWN_P else f"p = {p:.3f}"
    return f"{difference}, {said}{_choice(row)}"


def _listed(numbers: Sequence[int]) -> str:
    *before, last = map(str, numbers)
    return f"{', '.join(before)} and {last}" if before else last


def _name(group: Sequence[Row], rows: Sequence[Row]) -> str:
    """Return the policy, with its K and its settings if the same policy has other rows."""
    row = group[0]
    others = [other for other in rows if other.policy == row.policy]
    parts = [row.policy]
    if len(group) == 1 and len({other.n_action_steps for other in others}) > 1:
        parts.append(f"K={row.n_action_steps}")
    if row.variant and len({other.variant for other in others}) > 1:
        parts.append(row.variant)
    return ", ".join(parts)


def _choice(row: Row) -> str:
    n_right = row[CHOICES].n_chose_right
    return "" if n_right is None else f"; first choice right in {n_right} of {row[EPISODES].n_episodes}"
