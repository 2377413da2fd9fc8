"""Find the worlds of probes and grids among run folders: their names say what was changed.

A probe is the worlds of one folder. Knows nothing of statistics.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.config.evaluation import EvalConfig
from vla_eval.probe.grid import GridWorld
from vla_eval.probe.interventions import PROBES, Intervention, Level, World
from vla_eval.probe.phases import fixed_phases
from vla_eval.results.grouping import config_names
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.catalog import TASKS, task_spec

_INTERVENTIONS: tuple[Intervention, ...] = ("none", *PROBES)
_GRID_NAME = re.compile(r"grid_(?P<axis>delay|cue)_(?P<level>\d+)_from_(?P<first>\d+)")


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundWorld:
    """A world of a probe, and its run folder."""

    world: World
    run: StoredRun


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundGridWorld:
    """A world of a grid, and its run folder."""

    world: GridWorld
    run: StoredRun


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundProbe:
    """The worlds that lie in one folder.

    Attributes:
        folder: where their run folders are.
        worlds: of tasks whose world as drawn is there, too: by task, then in the order of `PROBES`.
        grid: of a grid.
        doubles: notes on run folders that have the name of another one, and are left out.
    """

    folder: Path
    worlds: tuple[FoundWorld, ...]
    grid: tuple[FoundGridWorld, ...]
    doubles: tuple[str, ...]


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
    return FoundProbe(
        folder=folder,
        worlds=_worlds(tuple(first.values())),
        grid=_grid(tuple(first.values())),
        doubles=tuple(
            f"{run.path}: it has the name of {first[run.description.name].path}, and is not in this section."
            for run in doubles
        ),
    )


def _worlds(runs: Sequence[StoredRun]) -> tuple[FoundWorld, ...]:
    found: dict[tuple[str, Intervention, Level], FoundWorld] = {}
    for run in runs:
        world = _world(run)
        if world is not None:
            found[world.task, world.intervention, world.level] = FoundWorld(world=world, run=run)
    # A single world is an evaluation like any other.
    tasks = dict.fromkeys(
        task for task, intervention, _ in found if intervention != "none" and (task, "none", None) in found
    )
    ranks = {task: rank for rank, task in enumerate(tasks)}
    own = [one for (task, _, _), one in found.items() if task in ranks]
    return tuple(sorted(own, key=lambda one: (ranks[one.world.task], *_rank(one.world))))


def _rank(world: World) -> tuple[int, int, str]:
    level = world.level
    number = level if isinstance(level, int) else 0
    return _INTERVENTIONS.index(world.intervention), number, str(level)


def _world(run: StoredRun) -> World | None:
    """Return the world that a run folder is of; None if its name is not that of one."""
    task, rest = _task_and_rest(run)
    if task is None:
        return None
    for intervention in sorted(_INTERVENTIONS, key=len, reverse=True):  # `delay_swap` before `delay`
        if rest == intervention or rest.startswith(f"{intervention}_"):
            level = rest.removeprefix(intervention).removeprefix("_")
            return World(task=task, intervention=intervention, level=_level(level), config=_config(run, task))
    return None


def _level(text: str) -> Level:
    return None if not text else int(text) if text.isdecimal() else text


def _grid(runs: Sequence[StoredRun]) -> tuple[FoundGridWorld, ...]:
    found: dict[tuple[str, str, int, int], FoundGridWorld] = {}
    for run in runs:
        task, rest = _task_and_rest(run)
        named = _GRID_NAME.fullmatch(rest)
        if task is None or named is None:
            continue
        config = _config(run, task)
        world = GridWorld(
            task=task,
            axis="delay" if named["axis"] == "delay" else "cue",
            level=int(named["level"]),
            first_inference_step=int(named["first"]),
            phases=fixed_phases(task_spec(task), config.env),
            config=config,
        )
        key = (task, world.axis, world.level, world.first_inference_step)
        found[key] = FoundGridWorld(world=world, run=run)
    return tuple(found[key] for key in sorted(found))


def _task_and_rest(run: StoredRun) -> tuple[str | None, str]:
    """Return the task of a run that has just one, and what follows it in the run's name."""
    tasks = config_names(run, "tasks")
    name = run.description.name
    if len(tasks) != 1 or tasks[0] not in TASKS or not name.startswith(f"{tasks[0]}_"):
        return None, ""
    return tasks[0], name.removeprefix(f"{tasks[0]}_")


def _config(run: StoredRun, task: str) -> EvalConfig:
    """Return the part of the configuration that the table of a probe needs."""
    env = run.description.config.get("env")
    return EvalConfig(
        name=run.description.name,
        tasks=(task,),
        policies=config_names(run, "policies"),
        env=dict(env) if isinstance(env, dict) else {},
    )
