"""Scores of MIKASA-Base by type of memory, below the success table."""

import math
from collections.abc import Iterator
from typing import NamedTuple, get_args

from vla_eval.results.own_statistics import RETURN, rate
from vla_eval.results.printed_table import Column, SideTable, cells_of
from vla_eval.results.success_table import Table
from vla_eval.tasks.catalog import find_task
from vla_eval.tasks.spec import MemoryType


class TypeScore(NamedTuple):
    """The mean normalised score of a policy over the tasks that need a type of memory."""

    memory: str
    policy: str
    n_tasks: int
    score: float


def type_scores(table: Table) -> Iterator[TypeScore]:
    """Yield the mean score of each type of memory and policy, over the tasks that have a score."""
    for memory in get_args(MemoryType):
        for policy in dict.fromkeys(row.policy for row in table.rows):
            scores = []
            for row in table.rows:
                spec, score = find_task(row.task), row[RETURN].normalised
                if row.policy == policy and score is not None and spec and memory in spec.memory_types:
                    scores.append(score)
            if scores:
                yield TypeScore(memory, policy, len(scores), math.fsum(scores) / len(scores))


def memory_side_tables(table: Table) -> list[SideTable]:
    """Return the table of scores by type of memory, if there are several tasks with a score."""
    scores = tuple(type_scores(table))
    if len({row.task for row in table.rows if row[RETURN].normalised is not None}) < 2:
        return []
    columns: list[Column[TypeScore]] = [
        Column("memory", lambda one: one.memory, is_number=False),
        Column("policy", lambda one: one.policy, is_number=False),
        Column("tasks", lambda one: str(one.n_tasks)),
        Column("normalised", lambda one: rate(one.score)),
    ]
    note = "a task with several types of memory counts for each of them; tasks without a score for none."
    return [
        SideTable(
            title="MIKASA-Base by type of memory: mean normalised score over its tasks",
            columns=columns,
            rows=cells_of(columns, scores),
            notes=(note,),
            csv_columns=("memory",),
            csv_rows=[_csv_row(one) for one in scores],
            json={"memory_types": [one._asdict() for one in scores]},
        )
    ]


def _csv_row(one: TypeScore) -> dict[str, object]:
    return {
        "source": "mean over tasks",
        "task": f"mean of {one.n_tasks} tasks",
        "policy": one.policy,
        "memory": one.memory,
        "return_normalised": one.score,
    }
