"""What follows the memory that was put in: one candidate, several, or several in their order."""

from dataclasses import replace

import pytest

from tests.probe.test_probe import config
from vla_eval.probe.interventions import plan_probe
from vla_eval.probe.table import probe_table
from vla_eval.probe.worlds import ProbeSettings
from vla_eval.records import EpisodeRecord
from vla_eval.tasks.catalog import task_spec

DRAWN, SWAPPED = (4, 1, 7), (2, 1, 7)  # the swap shows another item in the place of the first


def episode(task: str, right: tuple[int, ...], touched: tuple[int, ...]) -> EpisodeRecord:
    """An episode with nine candidates; of one right candidate it is the target, as in records."""
    in_order = task.startswith("Chain")
    won = touched[: len(right)] == right if in_order else set(touched[: len(right)]) == set(right)
    return EpisodeRecord(
        task=task,
        policy="p",
        n_action_steps=1,
        run=0,
        seed=1,
        outcome="success" if won else "failure",
        success_once=won,
        target=right[0] if len(right) == 1 else None,
        n_candidates=9,
        first_choice=touched[0] if touched else None,
        first_choice_success=bool(touched) and touched[0] in (right[:1] if in_order else right),
        right_candidates=right,
        touched_candidates=touched,
        candidate_places=tuple(range(9)),
    )


@pytest.mark.parametrize(
    ("task", "touched", "follows"),
    [
        ("RememberColor9-v0", (2,), True),
        ("RememberColor9-v0", (4,), False),  # the world's own
        ("RememberColor9-v0", (2, 4), True),  # what comes later is no choice
        ("RememberColor9-v0", (), False),
        ("SeqOfColors3-v0", (7, 2, 1), True),  # in any order
        ("SeqOfColors3-v0", (2, 1, 7, 0), True),
        ("SeqOfColors3-v0", (2, 1), False),  # not all of them
        ("SeqOfColors3-v0", (2, 0, 1, 7), False),  # a wrong one between them
        ("SeqOfColors3-v0", DRAWN, False),
        ("SeqOfColors3-v0", (), False),
        ("ChainOfColors3-v0", SWAPPED, True),
        ("ChainOfColors3-v0", (2, 7, 1), False),  # out of order
        ("ChainOfColors3-v0", (2, 1), False),
        ("ChainOfColors3-v0", DRAWN, False),
    ],
)
def test_a_transplanted_memory_is_followed_if_all_it_makes_right_is_chosen(
    task: str, touched: tuple[int, ...], follows: bool
) -> None:
    n_right = 1 if task.startswith("Remember") else 3
    assert (task_spec(task).memory == "sequential") == task.startswith("Chain")
    drawn, swapped = DRAWN[:n_right], SWAPPED[:n_right]
    probes = ProbeSettings(probes=("swap", "transplant"))
    worlds = [
        world
        for world in plan_probe(config(tasks=(task,)), probes).worlds
        if world.intervention in ("none", "swap")
    ]
    worlds.append(replace(worlds[0], intervention="transplant", level=1))
    done = {
        "none": episode(task, drawn, drawn),
        "swap": episode(task, swapped, swapped),
        "transplant": episode(task, drawn, touched),
    }
    table = probe_table(worlds, [[done[world.intervention]] for world in worlds])
    (row,) = [row for row in table.rows if row.intervention == "transplant"]
    assert row.followed_memory == (int(follows), 1)
