"""Find the worlds of probes and grids among run folders, by what their `run.json` states."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vla_eval.config.evaluation import EvalConfig, ProbedWorld
from vla_eval.config.recorded_chunking import read_chunking
from vla_eval.errors import check_names
from vla_eval.probe.choice_pairs import ChoicePairs, choice_pairs
from vla_eval.probe.grid import AXES, GridWorld, named_grid_world
from vla_eval.probe.grid_table import GridTable, grid_table
from vla_eval.probe.interventions import INTERVENTIONS, named_world
from vla_eval.probe.phases import fixed_phases
from vla_eval.probe.table import ProbeTable, policy_order, table_of_runs
from vla_eval.probe.world_records import by_policy
from vla_eval.probe.worlds import AS_DRAWN, World
from vla_eval.results.grouping import config_names
from vla_eval.storage.run_file import RUN_FILE
from vla_eval.storage.run_folder import StoredRun
from vla_eval.strict.decoding import check_value
from vla_eval.tasks.catalog import TASKS, task_spec


@dataclass(frozen=True, slots=True, kw_only=True)
class Found[W]:
    """A world, and its run folder."""

    world: W
    run: StoredRun


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundProbe:
    """The worlds that lie in one folder."""

    folder: Path
    # of tasks whose world as drawn is there, too: by task, then in the order of `INTERVENTIONS`
    worlds: tuple[Found[World], ...]
    grid: tuple[Found[GridWorld], ...]
    doubles: tuple[str, ...]  # notes on run folders that have the name of another one, and are left out

    def table(self) -> ProbeTable:
        """Return the table of the worlds, as `mikasa-vla probe` prints it."""
        return table_of_runs([one.world for one in self.worlds], [one.run for one in self.worlds])

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
    found = [(world, run) for run in first.values() if (world := _world(run)) is not None]
    worlds = [Found(world=world, run=run) for world, run in found if isinstance(world, World)]
    grid = [Found(world=world, run=run) for world, run in found if isinstance(world, GridWorld)]
    return FoundProbe(
        folder=folder,
        worlds=_with_drawn(worlds),
        grid=tuple(sorted(grid, key=lambda one: one.world.place)),
        doubles=tuple(
            f"{run.path}: it has the name of {first[run.description.name].path}, and is not in this section."
            for run in doubles
        ),
    )


def _world(run: StoredRun) -> World | GridWorld | None:
    """Return the world that a run is, as its `run.json` states; None if it is not one of a probe."""
    tasks = config_names(run, "tasks")
    if len(tasks) != 1 or tasks[0] not in TASKS:
        return None
    stated = _stated(run, tasks[0])
    if stated is None:
        return None
    env = run.description.config.get("env")
    config = EvalConfig(  # the part that the table of a probe needs
        name=run.description.name,
        tasks=tasks,
        policies=config_names(run, "policies"),
        env=dict(env) if isinstance(env, dict) else {},
    )
    where = f"{run.path / RUN_FILE}, options.world.change"
    if stated.first_inference_step is None:
        check_names("intervention", [stated.change], (AS_DRAWN, *INTERVENTIONS), where=where)
        return World(task=tasks[0], intervention=stated.change, level=stated.level, config=config)
    check_names("axis", [stated.change], AXES, where=where)
    section, spec = run.description.config.get("chunking"), task_spec(tasks[0])
    chunking = read_chunking(section if isinstance(section, dict) else {}, where=str(run.path))
    return GridWorld(
        task=tasks[0],
        axis=next(axis for axis in AXES if axis == stated.change),
        level=int(stated.level or 0),
        first_inference_step=stated.first_inference_step,
        phases=None if spec.candidates is None else fixed_phases(spec, config.env),
        config=replace(config, chunking=chunking),
    )


def _stated(run: StoredRun, task: str) -> ProbedWorld | None:
    name, options = run.description.name, run.description.options
    if "world" not in options:
        # Folders of versions that did not write the field: only their name says it, after that of the task.
        if not name.startswith(f"{task}_"):
            return None
        rest = name.removeprefix(f"{task}_")
        return named_world(rest) or named_grid_world(rest)
    stated: ProbedWorld | None = check_value(
        ProbedWorld | None, options["world"], path=f"{run.path / RUN_FILE}: options.world"
    )
    return stated


def _with_drawn(found: Sequence[Found[World]]) -> tuple[Found[World], ...]:
    """Return the worlds of the tasks that have others than the one as drawn, and that one, too."""
    drawn = {one.world.task for one in found if one.world.intervention == AS_DRAWN}
    # A single world is an evaluation like any other.
    tasks = [one.world.task for one in found if one.world.intervention != AS_DRAWN]
    ranks = {task: rank for rank, task in enumerate(dict.fromkeys(tasks)) if task in drawn}
    own = [one for one in found if one.world.task in ranks]
    return tuple(sorted(own, key=lambda one: (ranks[one.world.task], *_rank(one.world))))


def _rank(world: World) -> tuple[int, float, str]:
    level = world.level
    number = level if isinstance(level, int) else _number(level)
    return [AS_DRAWN, *INTERVENTIONS].index(world.intervention), number, str(level)


def _number(level: str | None) -> float:
    """Return the number that a level is, such as a dose; 0 for a name."""
    try:
        return float(level or 0)
    except ValueError:
        return 0.0
