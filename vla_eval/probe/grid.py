"""The evaluations of a grid: chunk lengths against the length of a phase, at each first inference.

Where K does not divide the phases, how much of the cue falls between two inferences depends on where the
first one is. So every first inference below K is run there.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

from vla_eval.config.evaluation import EvalConfig, ProbedWorld
from vla_eval.errors import RecipeError
from vla_eval.probe.interventions import refuse_own_arguments
from vla_eval.probe.phases import Phases, divides, fixed_phases
from vla_eval.tasks.catalog import robot_task
from vla_eval.tasks.spec import TaskSpec

Axis = Literal["delay", "cue"]
AXES: tuple[Axis, ...] = ("delay", "cue")

DEFAULT_N_ACTION_STEPS = (1, 2, 4, 8)
DEFAULT_GRID_DELAYS = (0, 5, 20, 80)
DEFAULT_GRID_CUES = (1, 2, 3, 5)

ORACLE = "oracle"
CUE_READER = "cue_reader"
_NAME = re.compile(r"grid_(?P<axis>delay|cue)_(?P<level>\d+)_from_(?P<first>\d+)")  # after the task
CONTROLS = (ORACLE, CUE_READER)
"""Arms that forget nothing: one knows the cue in any case, one only from the frames of its inferences."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridSettings:
    """What a grid varies, in addition to the chunk lengths of the evaluation."""

    axes: tuple[Axis, ...] = ("delay",)  # which phases get other lengths
    # `delays`, `cues`: these lengths, in control steps
    delays: tuple[int, ...] = DEFAULT_GRID_DELAYS
    cues: tuple[int, ...] = DEFAULT_GRID_CUES
    # which first inferences are run; none: all below K where K does not divide the phases
    first_inferences: tuple[int, ...] = ()
    controls: bool = True  # whether `CONTROLS` are run with the policies


@dataclass(frozen=True, slots=True, kw_only=True)
class GridWorld:
    """One evaluation of a grid: a phase of `level` control steps, and a first inference, at some K."""

    task: str
    axis: Axis
    level: int
    first_inference_step: int
    phases: Phases
    config: EvalConfig

    @property
    def place(self) -> tuple[str, str, int, int]:
        """What distinguishes it from the other worlds of a grid."""
        return self.task, self.axis, self.level, self.first_inference_step


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


def plan_grid(config: EvalConfig, settings: GridSettings) -> Grid:
    """Return the evaluations that a grid consists of, at `DEFAULT_N_ACTION_STEPS` unless K is configured."""
    refuse_own_arguments(config)
    if config.chunking.first_inference_step:
        raise RecipeError("chunking.first_inference_step: a grid sets it itself. Use --first-inference.")
    worlds: list[GridWorld] = []
    left_out: list[str] = []
    for task in config.tasks:
        spec = robot_task(task, does="`probe --grid` changes")
        if spec.candidates is None:
            left_out.append(f"{spec.id}: it has no phases")
            continue
        found = [world for axis in settings.axes for world in _worlds(spec, config, settings, axis)]
        worlds += found
        if not found:
            left_out.append(f"{spec.id}: no K has one of these first inferences")
    if not worlds:
        raise RecipeError(f"--grid: there is nothing to run ({'; '.join(left_out)}).")
    return Grid(worlds=tuple(worlds), left_out=tuple(left_out))


def first_inferences(phases: Phases, n_action_steps: int) -> tuple[int, ...]:
    """Return the first inferences that are to be run: 0 alone where every phase begins with an inference."""
    return (0,) if divides(phases, n_action_steps) else tuple(range(n_action_steps))


def _worlds(spec: TaskSpec, config: EvalConfig, settings: GridSettings, axis: Axis) -> Iterator[GridWorld]:
    """Yield the evaluations of a task with other lengths of one phase."""
    usual = fixed_phases(spec, config.env)
    sizes = config.n_action_steps or DEFAULT_N_ACTION_STEPS
    controls = CONTROLS if settings.controls else ()
    policies = (*config.policies, *(control for control in controls if control not in config.policies))
    for level in settings.delays if axis == "delay" else settings.cues:
        env = {**config.env, **usual.with_length(axis, level)}
        phases = fixed_phases(spec, env)
        firsts = {k: first_inferences(phases, k) for k in sizes}
        for first in range(max(sizes)):
            own = tuple(k for k in sizes if first in firsts[k])
            if not own or (settings.first_inferences and first not in settings.first_inferences):
                continue
            of_world = replace(
                config,
                name=f"{spec.id}_grid_{axis}_{level}_from_{first}",
                tasks=(spec.id,),
                policies=policies,
                n_action_steps=own,
                env=env,
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
