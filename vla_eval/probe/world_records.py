"""The records of a task's worlds by policy, and which world another one is compared with. Reads no files."""

from collections.abc import Iterable, Mapping, Sequence

from vla_eval.probe.quantities import Answer, follows, right_answer
from vla_eval.probe.worlds import AS_DRAWN, World
from vla_eval.records import EpisodeRecord
from vla_eval.results.comparison import CHANCE_POLICY
from vla_eval.tasks.catalog import task_spec

Records = Mapping[tuple[str, int], Sequence[EpisodeRecord]]
"""(policy, n_action_steps) -> records of one world."""

Worlds = Sequence[tuple[World, Records]]
"""The worlds of one task."""


def by_policy(records: Iterable[EpisodeRecord]) -> Records:
    """Sort the records of one world."""
    found: dict[tuple[str, int], list[EpisodeRecord]] = {}
    for record in records:
        found.setdefault((record.policy, record.n_action_steps), []).append(record)
    return found


def compared_with(world: World, worlds: Worlds) -> Records:
    """Return the records of the world that this one is compared with; none if it was not run."""
    wanted = ("delay", world.level) if world.intervention == "delay_swap" else (AS_DRAWN, None)
    own = (found for world, found in worlds if (world.intervention, world.level) == wanted)
    return next(own, {})


def donor_answers(world: World, worlds: Worlds, key: tuple[str, int]) -> dict[tuple[int, int], Answer | None]:
    """Return (run, seed) -> what the memory that is put into this episode makes right, of a policy and K."""
    if world.intervention == "transplant":
        donors, later = ("swap", world.level), 0
    elif world.intervention == "carry_over":
        donors, later = (AS_DRAWN, None), 1
    else:
        return {}
    own = (found for other, found in worlds if (other.intervention, other.level) == donors)
    spec = task_spec(world.task)
    records = results_of(next(own, {}).get(key, ()))
    return {(one.run, one.seed + later): right_answer(one, spec) for one in records}


def results_of(records: Iterable[EpisodeRecord]) -> list[EpisodeRecord]:
    """Return the records with a result."""
    return [record for record in records if record.outcome != "error"]


def chance_of(records: Sequence[EpisodeRecord], found: Records, n_action_steps: int) -> float | None:
    """Return the records' chance level, or what the blind arm has in this world; None if neither is known."""
    known = {record.chance_success for record in records}
    if len(known) == 1 and None not in known:
        return known.pop()
    blind = results_of(found.get((CHANCE_POLICY, n_action_steps), ()))
    return sum(map(follows, blind)) / len(blind) if blind else None
