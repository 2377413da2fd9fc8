"""The table of statistics, a row each, from which all is printed; docs/statistics.md explains them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from vla_eval.results import own_statistics as own
from vla_eval.results.comparison import Evidence, Success
from vla_eval.results.grouping import RowEpisodes, RowKey, Run
from vla_eval.results.motion_statistics import SMOOTHNESS, TIMING
from vla_eval.results.printed_table import UNDEFINED, Column
from vla_eval.results.relative_statistics import CEILING, CHANCE, CORRECTED, NO_BASELINES, PAIRED
from vla_eval.results.success_table import Row, Statistic

STATISTICS: tuple[Statistic[Any], ...] = (  # Any: each has values of its own type
    *(own.EPISODES, own.SUCCESS, own.AT_END, own.FIRST_CHOICE, own.CHOICES, own.RETURN),
    *(own.STEPS, own.INFERENCES, TIMING, SMOOTHNESS),
    *(PAIRED, CHANCE, CEILING, CORRECTED),
)
"""In the order of the columns of CSV and JSON."""

_KEY_COLUMNS: tuple[Column[Row], ...] = (
    Column("task", lambda row: row.task, is_number=False, name="task", folds=True),
    Column("policy", lambda row: _policy(row), is_number=False, name="policy"),
    Column("K", lambda row: str(row.n_action_steps), name="K", folds=True),
    Column("variant", lambda row: row.variant or UNDEFINED, is_number=False, name="variant"),
)


def make_row(evidence: Evidence, *, run: Run | None = None) -> Row:
    """Return the row with the value of each statistic; see `Row`."""
    estimates = {statistic: statistic.estimate(evidence) for statistic in STATISTICS}
    return Row(episodes=evidence.episodes, estimates=estimates, run=run)


def column_names() -> list[str]:
    """Return the names of the columns of CSV and JSON, as a table without rows has them."""
    nothing = RowEpisodes(key=RowKey("", "", 0, None), runs=())
    evidence = Evidence(episodes=nothing, success=Success(), chance=None, ceiling=None, comparisons=())
    return list(make_row(evidence).to_dict())


def printed_columns(baselines: Sequence[str] = ()) -> Mapping[str, Column[Row]]:
    """Return the columns of tables for reading by their names, from the left."""
    found = list(_KEY_COLUMNS)
    for statistic in STATISTICS:
        found += statistic.columns
        if statistic.column_of is not None:
            names = (*baselines, *NO_BASELINES)[: max(len(NO_BASELINES), len(baselines))]
            found += [statistic.column_of(number, name) for number, name in enumerate(names)]
    return {column.name: column for column in sorted(found, key=lambda one: (one.is_last, one.rank))}


def row_notes(rows: Sequence[Row]) -> list[str]:
    """Return the notes on the rows' values, and where they mislead, in the order of the printed columns."""

    def place(statistic: Statistic[Any]) -> tuple[bool, float]:
        return min(((one.is_last, one.rank) for one in statistic.columns), default=(True, math.inf))

    return [note for statistic in sorted(STATISTICS, key=place) for note in statistic.notes(rows)]


def _policy(row: Row) -> str:
    if row.run is None:
        return row.policy
    copy = f", folder {row.run.copy + 1}" if row.run.copy else ""
    return f"{row.policy}, run {row.run.index}{copy}"
