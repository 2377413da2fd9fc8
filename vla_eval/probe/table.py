"""The table of a probe, from its run folders: a row per task, policy, n_action_steps and world."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vla_eval.probe.decoding import Decoded, decoded_memories
from vla_eval.probe.interventions import INTERVENTIONS
from vla_eval.probe.mistakes import Capacity, Mistakes, capacity, mistakes
from vla_eval.probe.phases import Inferences, Phases, inferences, n_cue_frames_after, phases_of
from vla_eval.probe.quantities import (
    Pair,
    SwapQuantities,
    follows,
    given_answer,
    pair_up,
    paired_p,
    right_answer,
    swap_quantities,
)
from vla_eval.probe.retention import Contrast, Followed, Range, contrast, share_left
from vla_eval.probe.retention_curves import Retention, retention_curves
from vla_eval.probe.world_records import (
    Records,
    Worlds,
    by_policy,
    chance_of,
    compared_with,
    donor_answers,
    results_of,
)
from vla_eval.probe.worlds import (
    AS_DRAWN,
    AT_RESPONSE,
    SWAPS,
    WITHOUT_MEMORY,
    Intervention,
    Level,
    World,
    delay_of,
    label_of,
)
from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import Share, holm
from vla_eval.results.grouping import config_names
from vla_eval.storage.run_folder import StoredRun, read_run
from vla_eval.tasks.catalog import task_spec


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeRow:
    """One policy in one world, compared with the world as it is drawn, or with another one of its delay."""

    task: str
    policy: str
    n_action_steps: int
    intervention: Intervention
    level: Level
    delay_steps: int | None  # its delay; None for a task without one
    # which inferences fall into the cue; None without phases, or if their lengths are drawn
    inferences: Inferences | None
    n_pairs: int  # episodes with a result in this world and in the one that it is compared with
    swap: SwapQuantities | None
    followed: Share | None
    # episodes of this world in which no candidate was touched; None without candidates
    n_without_choice: int | None
    success: Share | None  # episodes of this world that succeed; None without a result
    chance: float | None  # rate of following the cue without memory; None where it is not known
    mistakes: Mistakes | None  # the first mistakes of its episodes; None where touches are not known
    # how many items are kept; None where touches are not known, or one item is right
    kept: Capacity | None
    # of another appearance: by how much more is followed than after the longest delay
    over_delay: Contrast | None
    # share of following that this world leaves, and its interval; None for swaps and `none`
    left: tuple[float, Range] | None
    # episodes that follow the memory that was put in, of those in which it is another one than the cue's
    followed_memory: Share | None
    # frames of the cue that are shown after the memory is changed; 0 where it is not changed at the response
    n_cue_frames_after: int
    # exact paired test against that world; corrected_p: after Holm, over the table
    p_value: float | None
    corrected_p: float | None
    n_errors: int

    @property
    def label(self) -> str:
        """What is changed and by how much: `swap 1`."""
        return label_of(self.intervention, self.level)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeTable:
    """All rows, in the order of the worlds, and the retention curves."""

    rows: tuple[ProbeRow, ...]
    retention: tuple[Retention, ...]
    decoded: tuple[Decoded, ...] = ()  # what linear probes find in memories that were kept

    @property
    def n_errors(self) -> int:
        """The number of episodes without a result."""
        return sum(row.n_errors for row in self.rows)


def read_probe(worlds: Sequence[World], out: Path) -> ProbeTable:
    """Read the run folders of all worlds and return their table."""
    return table_of_runs(worlds, [read_run(out / world.config.name) for world in worlds])


def table_of_runs(worlds: Sequence[World], runs: Sequence[StoredRun]) -> ProbeTable:
    """Return the table of worlds and their runs."""
    changed = {world.task for world in worlds if _is_of_memory(world)}
    without_memory = {
        (world.task, policy)
        for world, run in zip(worlds, runs, strict=True)
        for policy, parts in run.description.memories.items()
        if world.task in changed and not parts
    }
    table = probe_table(
        worlds, [run.records for run in runs], order=policy_order(runs), without_memory=without_memory
    )
    return replace(table, decoded=tuple(decoded_memories(worlds, runs)))


def policy_order(runs: Sequence[StoredRun]) -> tuple[str, ...]:
    """Return the policies of some runs: as their configurations name them, then others by name."""
    named = dict.fromkeys(name for run in runs for name in config_names(run, "policies"))
    others = {record.policy for run in runs for record in run.records} - set(named)
    return (*named, *sorted(others))


def probe_table(
    worlds: Sequence[World],
    records: Sequence[Sequence[EpisodeRecord]],
    *,
    order: Sequence[str] = (),
    without_memory: Collection[tuple[str, str]] = (),
) -> ProbeTable:
    """Return the table of worlds, `none` of each task first, policies in this order, then by name.

    `without_memory`: (task, policy) for which a row says that there is no memory that could be changed.
    """
    by_world = [(world, by_policy(found)) for world, found in zip(worlds, records, strict=True)]
    drawn = {world.task: found for world, found in by_world if world.intervention == AS_DRAWN}
    ranks = {name: rank for rank, name in enumerate(order)}
    rows, retention = [], []
    for task in dict.fromkeys(world.task for world in worlds):
        of_task = [(world, found) for world, found in by_world if world.task == task]
        # The policies in their order, each by growing n_action_steps.
        for policy, k in sorted(drawn[task], key=lambda key: (ranks.get(key[0], len(ranks)), *key)):
            ran = [one for one in of_task if (policy, k) in one[1] or not _is_of_memory(one[0])]
            own = [_row(world, found, of_task, policy, k) for world, found in ran]
            rows += with_contrasts(own, ran)
            if (task, policy) in without_memory:
                rows.append(_row_without_memory(ran[0][0], policy, k))
            retention += retention_curves(of_task, policy, k)
    tested = [row.p_value for row in rows if row.p_value is not None]
    corrected = iter(holm(tested))
    rows = [row if row.p_value is None else replace(row, corrected_p=next(corrected)) for row in rows]
    return ProbeTable(rows=tuple(rows), retention=tuple(retention))


def _is_of_memory(world: World) -> bool:
    return world.intervention != AS_DRAWN and INTERVENTIONS[world.intervention].of_memory


def _row(world: World, found: Records, worlds: Worlds, policy: str, k: int) -> ProbeRow:
    own = found.get((policy, k), ())
    results = results_of(own)
    pairs = pair_up(compared_with(world, worlds).get((policy, k), ()), own)
    spec = task_spec(world.task)
    put_in = donor_answers(world, worlds, (policy, k))
    told_apart = [
        record
        for record in results
        if put_in.get((record.run, record.seed)) not in (None, right_answer(record, spec))
    ]
    choosing = [record for record in results if record.n_candidates]
    is_swap = world.intervention in SWAPS
    swap = swap_quantities(pairs, spec) if is_swap else None
    compared = not is_swap and world.intervention != AS_DRAWN
    phases = phases_of(spec, world.config.env)
    p_value = swap.p_value if swap is not None else paired_p(pairs) if compared else None
    return ProbeRow(
        task=world.task,
        policy=policy,
        n_action_steps=k,
        intervention=world.intervention,
        level=world.level,
        delay_steps=delay_of(world.config),
        inferences=inferences(phases, k) if isinstance(phases, Phases) else None,
        n_pairs=len(pairs),
        swap=swap,
        followed=Share.counted(results, follows),
        n_without_choice=sum(record.first_choice is None for record in choosing) if choosing else None,
        success=Share.counted(results, lambda record: bool(record.success_once)),
        chance=chance_of(results, found, k),
        mistakes=mistakes(results, spec),
        kept=capacity(results),
        over_delay=None,
        followed_memory=Share.counted(
            told_apart, lambda record: given_answer(record, spec) == put_in[record.run, record.seed]
        ),
        n_cue_frames_after=(
            n_cue_frames_after(phases, k)
            if isinstance(phases, Phases) and world.intervention in AT_RESPONSE
            else 0
        ),
        left=share_left(*_followed(pairs)) if compared and pairs else None,
        p_value=p_value,
        corrected_p=None,
        n_errors=len(own) - len(results),
    )


def _row_without_memory(drawn: World, policy: str, k: int) -> ProbeRow:
    """Return the row that says so: of a world in which nothing was run."""
    world = replace(drawn, intervention=WITHOUT_MEMORY)
    return replace(_row(world, {}, (), policy, k), inferences=None)


def with_contrasts(rows: Sequence[ProbeRow], worlds: Worlds) -> list[ProbeRow]:
    """Compare the rows of an appearance with that of the longest delay; a row per world, of one policy."""
    delays = [
        (row.delay_steps, index)
        for index, row in enumerate(rows)
        if row.intervention == "delay" and row.delay_steps is not None and row.followed
    ]
    if not delays:
        return list(rows)
    longest, index = max(delays)
    compared = []
    for row, (_, found) in zip(rows, worlds, strict=True):
        key = (row.policy, row.n_action_steps)
        pairs = pair_up(worlds[index][1].get(key, ()), found.get(key, ()))
        if row.intervention == "appearance" and pairs:
            row = replace(row, over_delay=contrast(longest, *_followed(pairs)))
        compared.append(row)
    return compared


def _followed(pairs: Sequence[Pair]) -> tuple[Followed, Followed]:
    drawn = np.array([follows(pair.drawn) for pair in pairs], dtype=bool)
    return drawn, np.array([follows(pair.other) for pair in pairs], dtype=bool)
