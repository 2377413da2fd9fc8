"""Find the worlds of probes and grids among run folders, by the names in their `run.json`."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.config.evaluation import EvalConfig
from vla_eval.probe.choice_pairs import ChoicePairs, choice_pairs
from vla_eval.probe.grid import GridWorld, named_grid_world
from vla_eval.probe.grid_table import GridTable, grid_table
from vla_eval.probe.interventions import INTERVENTIONS, named_world
from vla_eval.probe.table import ProbeTable, policy_order, probe_table
from vla_eval.probe.world_records import by_policy
from vla_eval.probe.worlds import AS_DRAWN, World
from vla_eval.results.grouping import config_names
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.catalog import TASKS


@dataclass(frozen=True, slots=True, kw_only=True)
class Found[W]:
    """A world, and its run folder."""

    world: W
    run: StoredRun


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundProbe:
    """The worlds that lie in one folder.

    Attributes:
        worlds: of tasks whose world as drawn is there, too: by task, then in the order of `INTERVENTIONS`.
        doubles: notes on run folders that have the name of another one, and are left out.
    """

    folder: Path
    worlds: tuple[Found[World], ...]
    grid: tuple[Found[GridWorld], ...]
    doubles: tuple[str, ...]

    def table(self) -> ProbeTable:
        """Return the table of the worlds, as `mikasa-vla probe` prints it."""
        order = policy_order([one.run for one in self.worlds])
        return probe_table(
            [one.world for one in self.worlds], [one.run.records for one in self.worlds], order=order
        )

    def grid_table(self) -> GridTable:
        """Return the table of the grid, as `mikasa-vla probe --grid` prints it."""
        return grid_table([one.world for one in self.grid], [one.run.records for one in self.grid])

    def pairs(self) -> list[ChoicePairs]:
        """Return the pairs by choice of each policy: by task, then in the order of the policies."""
        order = policy_order([one.run for one in self.worlds])
        found = []
        for task in dict.fromkeys(one.world.task for one in self.worlds):
            own = [(one.world, by_policy(one.run.records)) for one in self.worlds if one.world.task == task]
            keys = dict.fromkeys(key for _, records in own for key in records)
            for policy, k in sorted(keys, key=lambda key: (order.index(key[0]), key[1])):
                found += choice_pairs(own, policy, k)
        return found


def find_probes(runs: Sequence[StoredRun]) -> list[FoundProbe]:
    """Return the probes among some run folders, in the order of their folders; each folder counts once."""
    by_folder: dict[Path, list[StoredRun]] = {}
    for run in {run.path.resolve(): run for run in runs}.values():
        by_folder.setdefault(run.path.parent, []).append(run)
    probes = [_probe(folder, own) for folder, own in by_folder.items()]
    return [probe for probe in probes if probe.worlds or probe.grid]


def _probe(folder: Path, runs: Sequence[StoredRun]) -> FoundProbe:
    first: dict[str, StoredRun] = {}
    for run in runs:
        first.setdefault(run.description.name, run)
    doubles = [run for run in runs if run is not first[run.description.name]]
    grid = _found(first.values(), named_grid_world)
    return FoundProbe(
        folder=folder,
        worlds=_with_drawn(_found(first.values(), named_world)),
        grid=tuple(sorted(grid, key=lambda one: one.world.place)),
        doubles=tuple(
            f"{run.path}: it has the name of {first[run.description.name].path}, and is not in this section."
            for run in doubles
        ),
    )


def _found[W](runs: Iterable[StoredRun], named: Callable[[str, str, EvalConfig], W | None]) -> list[Found[W]]:
    """Return the runs whose names, after that of their only task, are those of worlds."""
    found = []
    for run in runs:
        tasks, name = config_names(run, "tasks"), run.description.name
        if len(tasks) != 1 or tasks[0] not in TASKS or not name.startswith(f"{tasks[0]}_"):
            continue
        env = run.description.config.get("env")
        config = EvalConfig(  # the part that the table of a probe needs
            name=name,
            tasks=tasks,
            policies=config_names(run, "policies"),
            env=dict(env) if isinstance(env, dict) else {},
        )
        world = named(tasks[0], name.removeprefix(f"{tasks[0]}_"), config)
        found += [] if world is None else [Found(world=world, run=run)]
    return found


def _with_drawn(found: Sequence[Found[World]]) -> tuple[Found[World], ...]:
    """Return the worlds of the tasks that have others than the one as drawn, and that one, too."""
    drawn = {one.world.task for one in found if one.world.intervention == AS_DRAWN}
    # A single world is an evaluation like any other.
    tasks = [one.world.task for one in found if one.world.intervention != AS_DRAWN]
    ranks = {task: rank for rank, task in enumerate(dict.fromkeys(tasks)) if task in drawn}
    own = [one for one in found if one.world.task in ranks]
    return tuple(sorted(own, key=lambda one: (ranks[one.world.task], *_rank(one.world))))


def _rank(world: World) -> tuple[int, int, str]:
    level = world.level
    number = level if isinstance(level, int) else 0
    return [AS_DRAWN, *INTERVENTIONS].index(world.intervention), number, str(level)
