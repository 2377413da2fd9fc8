"""The tables of probes and grids whose run folders were found, as `mikasa-vla probe` prints them."""

from collections.abc import Sequence

from vla_eval.probe.choice_pairs import ChoicePairs, choice_pairs
from vla_eval.probe.find_worlds import FoundGridWorld, FoundWorld
from vla_eval.probe.grid_table import GridTable, grid_table
from vla_eval.probe.table import ProbeTable, policy_order, probe_table
from vla_eval.probe.world_records import by_policy


def found_table(worlds: Sequence[FoundWorld]) -> ProbeTable:
    """Return the table of a probe."""
    return probe_table(
        [one.world for one in worlds],
        [one.run.records for one in worlds],
        order=policy_order([one.run for one in worlds]),
    )


def found_grid(worlds: Sequence[FoundGridWorld]) -> GridTable:
    """Return the table of a grid."""
    return grid_table([one.world for one in worlds], [one.run.records for one in worlds])


def found_pairs(worlds: Sequence[FoundWorld]) -> list[ChoicePairs]:
    """Return the pairs by choice of each policy: by task, then in the order of the policies."""
    order = policy_order([one.run for one in worlds])
    found = []
    for task in dict.fromkeys(one.world.task for one in worlds):
        own = [(one.world, by_policy(one.run.records)) for one in worlds if one.world.task == task]
        keys = dict.fromkeys(key for _, records in own for key in records)
        for policy, k in sorted(keys, key=lambda key: (order.index(key[0]), key[1])):
            found += choice_pairs(own, policy, k)
    return found
