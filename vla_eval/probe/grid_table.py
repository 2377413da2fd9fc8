"""The table of a grid, from its run folders: a cell per policy, K and length, over all first inferences."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.probe.grid import CONTROLS, CUE_READER, ORACLE, Axis, GridWorld
from vla_eval.probe.phases import Inferences, inferences
from vla_eval.probe.quantities import follows, wilson_of_rate
from vla_eval.probe.world_records import Records, by_policy, results_of
from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import Interval, Share
from vla_eval.storage.run_folder import read_run

_Run = tuple[GridWorld, Records]


@dataclass(frozen=True, slots=True, kw_only=True)
class GridPart:
    """The episodes of a cell with one first inference."""

    first_inference_step: int
    # which inferences fall into the cue, and how many steps of the response are executed before the
    # first inference of the response
    inferences: Inferences
    # frames of the cue that the policy is given; None while no record says what it reads
    n_seen: int | None
    # `success`, `followed`: episodes that succeed, and that follow the cue; None without a result
    success: Share | None
    followed: Share | None
    n_errors: int


@dataclass(frozen=True, slots=True, kw_only=True)
class GridCell:
    """One policy at one K with one length of a phase, or of an inference in one mode."""

    task: str
    axis: Axis
    mode: str  # `chunking.mode`
    level: int
    policy: str
    n_action_steps: int
    n_cue_frames: int  # control steps at which a cue is in view
    parts: tuple[GridPart, ...]  # one for each first inference
    n_seeds: int  # different episodes; each is run at every first inference
    chance: float | None  # rate of following the cue without memory; None where it is not known
    # the control that has the same inferences and forgets nothing; None for controls, or if it was not
    # run
    reference: str | None

    @property
    def rate(self) -> float | None:
        """The share of all its episodes that succeed."""
        known = [part.success for part in self.parts if part.success is not None]
        return sum(one.n for one in known) / sum(one.of for one in known) if known else None

    @property
    def interval(self) -> Interval | None:
        """The interval of the rate, with a seed as one episode at however many first inferences it is run."""
        return None if self.rate is None else wilson_of_rate(self.rate, self.n_seeds)

    @property
    def n_errors(self) -> int:
        """The number of episodes without a result."""
        return sum(part.n_errors for part in self.parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class GridTable:
    """All cells: by task, phase or mode, and policy, then by K and length."""

    cells: tuple[GridCell, ...]

    @property
    def n_errors(self) -> int:
        """The number of episodes without a result."""
        return sum(cell.n_errors for cell in self.cells)

    def reference_of(self, cell: GridCell) -> GridCell | None:
        """Return the cell of the reference at the same K and length; None without one."""
        return None if cell.reference is None else self.of_policy(cell.reference, cell)

    def of_policy(self, policy: str, cell: GridCell) -> GridCell | None:
        """Return the cell of another policy at the same K and length; None without one."""
        key = (cell.task, cell.axis, cell.mode, cell.level, policy, cell.n_action_steps)
        keys = (
            (one.task, one.axis, one.mode, one.level, one.policy, one.n_action_steps) for one in self.cells
        )
        return next((one for one, own in zip(self.cells, keys, strict=True) if own == key), None)


def read_grid(worlds: Sequence[GridWorld], out: Path) -> GridTable:
    """Read the run folders of all worlds and return their table."""
    return grid_table(worlds, [read_run(out / world.config.name).records for world in worlds])


def grid_table(worlds: Sequence[GridWorld], records: Sequence[Sequence[EpisodeRecord]]) -> GridTable:
    """Return the table of these worlds, each with its records in any order."""
    found: dict[tuple[str, Axis, str], list[_Run]] = {}
    for world, own in zip(worlds, records, strict=True):
        group = (world.task, world.axis, world.chunking.mode)
        found.setdefault(group, []).append((world, by_policy(own)))
    return GridTable(cells=tuple(cell for runs in found.values() for cell in _cells(runs)))


def _cells(runs: Sequence[_Run]) -> list[GridCell]:
    keys = dict.fromkeys(key for _, found in runs for key in found)
    policies = list(dict.fromkeys(policy for policy, _ in keys))
    levels = dict.fromkeys(world.level for world, _ in runs)
    cells = []
    for policy in sorted(policies, key=lambda name: (name in CONTROLS, policies.index(name))):
        records = [record for _, found in runs for key in found if key[0] == policy for record in found[key]]
        numbers = [(one.n_frames, one.n_inferences) for one in records]
        known = [(frames, passes) for frames, passes in numbers if frames is not None and passes is not None]
        # Whether the policy is given every frame; None if no record shows it.
        every = any(frames > passes for frames, passes in known) if known else None
        # The control that has the same inferences and forgets nothing.
        control = ORACLE if every else CUE_READER
        is_known = every is not None and policy not in CONTROLS and control in policies
        for k in sorted({k for _, k in keys}):
            for level in levels:
                own = [
                    (world, found) for world, found in runs if world.level == level and (policy, k) in found
                ]
                if own:
                    cells.append(_cell(own, policy, k, every, control if is_known else None))
    return cells


def _cell(
    runs: Sequence[_Run], policy: str, k: int, reads_every: bool | None, reference: str | None
) -> GridCell:
    world = runs[0][0]
    results = [record for _, found in runs for record in results_of(found[policy, k])]
    chances = {record.chance_success for record in results}
    return GridCell(
        task=world.task,
        axis=world.axis,
        mode=world.chunking.mode,
        level=world.level,
        policy=policy,
        n_action_steps=k,
        n_cue_frames=_n_cue_frames(world),
        parts=tuple(_part(one, found[policy, k], k, reads_every) for one, found in runs),
        n_seeds=len({(record.run, record.seed) for record in results}),
        chance=chances.pop() if len(chances) == 1 else None,
        reference=reference,
    )


def _part(world: GridWorld, records: Sequence[EpisodeRecord], k: int, reads_every: bool | None) -> GridPart:
    results = results_of(records)
    found, n_frames = _inferences(world, k), _n_cue_frames(world)
    return GridPart(
        first_inference_step=world.first_inference_step,
        inferences=found,
        n_seen=None if reads_every is None else n_frames if reads_every else len(found.cue_steps),
        success=Share.counted(results, lambda record: bool(record.success_once)),
        followed=Share.counted(results, follows),
        n_errors=len(records) - len(results),
    )


def _n_cue_frames(world: GridWorld) -> int:
    return 0 if world.phases is None else world.phases.n_in_turn * world.phases.cue_steps


def _inferences(world: GridWorld, k: int) -> Inferences:
    """Return which inferences fall into the cue; none for a task without phases."""
    interval = world.chunking.at(k).interval_steps
    if world.phases is None or interval is None:
        return Inferences(cue_steps=(), n_late=0)
    return inferences(
        world.phases,
        interval,
        first_inference_step=world.first_inference_step,
        delay_steps=world.level if world.axis == "latency" else 0,
    )
