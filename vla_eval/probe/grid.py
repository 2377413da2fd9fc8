"""The evaluations of a grid: chunk lengths against the length of a phase or an inference, at each first one.

Where K does not divide the phases, how much of the cue falls between two inferences depends on where the
first one is. So every first inference below K is run there.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

from vla_eval.chunking import ChunkingSettings, Mode
from vla_eval.config.evaluation import EvalConfig, ProbedWorld
from vla_eval.errors import RecipeError
from vla_eval.probe.interventions import refuse_own_arguments
from vla_eval.probe.phases import Phases, divides, fixed_phases
from vla_eval.tasks.catalog import robot_task
from vla_eval.tasks.spec import TaskSpec

Axis = Literal["delay", "cue", "latency"]
AXES: Mapping[Axis, str] = {"delay": "delay", "cue": "cue", "latency": "inference"}
"""What is as long as the level says: a phase, or an inference (`chunking.delay`); and its word in tables."""

DEFAULT_N_ACTION_STEPS = (1, 2, 4, 8)
DEFAULT_GRID_DELAYS = (0, 5, 20, 80)
DEFAULT_GRID_CUES = (1, 2, 3, 5)
DEFAULT_GRID_LATENCIES = (0, 1, 2, 4, 8)
DEFAULT_GRID_MODES: tuple[Mode, ...] = ("receding_horizon", "wait")

ORACLE = "oracle"
CUE_READER = "cue_reader"
_NAME = re.compile(
    r"grid_(?P<axis>delay|cue)_(?P<level>\d+)_from_(?P<first>\d+)"
)  # after the task; of old folders
CONTROLS = (ORACLE, CUE_READER)
"""Arms that forget nothing: one knows the cue in any case, one only from the frames of its inferences."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridSettings:
    """What a grid varies, in addition to the chunk lengths of the evaluation."""

    axes: tuple[Axis, ...] = ("delay",)  # which phases get other lengths
    # `delays`, `cues`: these lengths, in control steps
    delays: tuple[int, ...] = DEFAULT_GRID_DELAYS
    cues: tuple[int, ...] = DEFAULT_GRID_CUES
    latencies: tuple[int, ...] = DEFAULT_GRID_LATENCIES  # of an inference, in control steps
    modes: tuple[Mode, ...] = DEFAULT_GRID_MODES  # of `chunking.mode`, with other latencies
    # which first inferences are run; none: all below K where K does not divide the phases
    first_inferences: tuple[int, ...] = ()
    controls: bool = True  # whether `CONTROLS` are run with the policies


@dataclass(frozen=True, slots=True, kw_only=True)
class GridWorld:
    """One evaluation of a grid: something of `level` control steps, and a first inference, at some K."""

    task: str
    axis: Axis
    level: int
    first_inference_step: int
    phases: Phases | None  # None for a task without any
    config: EvalConfig

    @property
    def chunking(self) -> ChunkingSettings:
        """How chunks are executed."""
        return self.config.chunking

    @property
    def place(self) -> tuple[str, str, int, int, str]:
        """What distinguishes it from the other worlds of a grid."""
        return self.task, self.axis, self.level, self.first_inference_step, self.chunking.mode


def named_grid_world(name: str) -> ProbedWorld | None:
    """Return the world that is called so, after its task; None if it is not the name of one."""
    named = _NAME.fullmatch(name)
    if named is None:
        return None
    return ProbedWorld(
        change=named["axis"], level=int(named["level"]), first_inference_step=int(named["first"])
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """The evaluations of a grid, and the tasks that have none, for a message."""

    worlds: tuple[GridWorld, ...]
    left_out: tuple[str, ...]

    @property
    def n_episodes(self) -> int:
        """How many episodes the evaluations have."""
        configs = [world.config for world in self.worlds]
        return sum(len(c.n_action_steps or ()) * len(c.policies) * c.runs * c.episodes for c in configs)


def plan_grid(config: EvalConfig, settings: GridSettings, *, chunk_size: int | None = None) -> Grid:
    """Return the evaluations that a grid consists of, at `DEFAULT_N_ACTION_STEPS` unless K is configured.

    Where latencies differ, those for which chunks of `chunk_size` actions are too short are left out.
    """
    refuse_own_arguments(config)
    if config.chunking.first_inference_step:
        raise RecipeError("chunking.first_inference_step: a grid sets it itself. Use --first-inference.")
    worlds: list[GridWorld] = []
    left_out: list[str] = []
    for task in config.tasks:
        spec = robot_task(task, does="`probe --grid` changes")
        found: list[GridWorld] = []
        for axis in settings.axes:
            if axis == "latency":
                found += _latency_worlds(spec, config, settings, chunk_size, left_out)
            elif spec.candidates is None:
                left_out.append(f"{spec.id}: it has no phases")
            else:
                found += _worlds(spec, config, settings, axis)
        worlds += found
        if not found and spec.candidates is not None:
            left_out.append(f"{spec.id}: no K has one of these first inferences")
    if not worlds:
        raise RecipeError(f"--grid: there is nothing to run ({'; '.join(left_out)}).")
    return Grid(worlds=tuple(worlds), left_out=tuple(left_out))


def first_inferences(phases: Phases | None, n_action_steps: int) -> tuple[int, ...]:
    """Return the first inferences that are to be run: 0 alone where every phase begins with an inference."""
    is_even = phases is None or divides(phases, n_action_steps)
    return (0,) if is_even else tuple(range(n_action_steps))


def _worlds(
    spec: TaskSpec, config: EvalConfig, settings: GridSettings, axis: Literal["delay", "cue"]
) -> Iterator[GridWorld]:
    """Yield the evaluations of a task with other lengths of one phase."""
    usual = fixed_phases(spec, config.env)
    sizes = config.n_action_steps or DEFAULT_N_ACTION_STEPS
    for level in settings.delays if axis == "delay" else settings.cues:
        of_level = replace(config, env={**config.env, **usual.with_length(axis, level)})
        yield from _at_each_first(spec, of_level, settings, axis, level, sizes)


def _latency_worlds(
    spec: TaskSpec,
    config: EvalConfig,
    settings: GridSettings,
    chunk_size: int | None,
    left_out: list[str],
) -> Iterator[GridWorld]:
    """Yield the evaluations of a task with inferences of other lengths, in each mode."""
    for mode, level in product(settings.modes, settings.latencies):
        chunking = replace(config.chunking, mode=mode, delay=level)
        sizes = config.n_action_steps or DEFAULT_N_ACTION_STEPS
        fitting = [k for k in sizes if chunk_size is None or chunking.at(k).min_chunk_size <= chunk_size]
        if len(fitting) < len(sizes):
            shown = ", ".join(str(k) for k in sizes if k not in fitting)
            left_out.append(
                f"{spec.id}: K = {shown} with a latency of {level} ({mode}): chunks have {chunk_size} actions"
            )
        if fitting:
            of_level = replace(config, chunking=chunking)
            yield from _at_each_first(spec, of_level, settings, "latency", level, tuple(fitting))


def _at_each_first(
    spec: TaskSpec,
    config: EvalConfig,
    settings: GridSettings,
    axis: Axis,
    level: int,
    sizes: tuple[int, ...],
) -> Iterator[GridWorld]:
    phases = None if spec.candidates is None else fixed_phases(spec, config.env)
    controls = [one for one in CONTROLS if settings.controls and (one == ORACLE or phases is not None)]
    policies = (*config.policies, *(control for control in controls if control not in config.policies))
    firsts = {k: first_inferences(phases, k) for k in sizes}
    mode = f"_{config.chunking.mode}" if axis == "latency" else ""
    for first in range(max(sizes)):
        own = tuple(k for k in sizes if first in firsts[k])
        if not own or (settings.first_inferences and first not in settings.first_inferences):
            continue
        of_world = replace(
            config,
            name=f"{spec.id}_grid_{axis}_{level}{mode}_from_{first}",
            tasks=(spec.id,),
            policies=policies,
            n_action_steps=own,
            chunking=replace(config.chunking, first_inference_step=first),
            world=ProbedWorld(change=axis, level=level, first_inference_step=first),
        )
        yield GridWorld(
            task=spec.id,
            axis=axis,
            level=level,
            first_inference_step=first,
            phases=phases,
            config=of_world,
        )
