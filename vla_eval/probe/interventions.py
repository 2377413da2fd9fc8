"""What a probe can change, a row for each intervention, and the evaluations that it consists of."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from vla_eval.config.environment import AS_DESIGNED
from vla_eval.config.evaluation import EvalConfig, ProbedWorld
from vla_eval.errors import RecipeError
from vla_eval.probe.worlds import APPEARANCES, AS_DRAWN, Intervention, ProbeSettings, TaskWorlds, World
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.catalog import robot_task

OWN_ARGUMENTS = (
    *("swap_cue", "swap_order", "show_cue", "shuffle_cue", "cue_after_steps", "distract_steps"),
    "move_in_delay",
)
OWN_FIELDS: Mapping[str, object] = {
    "reset_policy_at_step": None,
    "cue_view": "as_shown",
    "memory_change": None,
    "appearance": AS_DESIGNED,
}
"""Fields of an evaluation that a probe changes, and their values in the world as drawn."""

NO_MEMORY = "no policy has a memory that can be changed"

LEAST_MOTION_STEPS = 2
"""One step out and one back."""


class Rule(NamedTuple):
    """One intervention."""

    worlds: Callable[[TaskWorlds], list[World]]
    why_not: str  # why there are none, for a message
    # how a sentence begins that says in how many episodes the cue is followed; `{level}` is the level.
    # Swaps have a sentence of their own.
    clause: str = ""
    needs_phases: bool = True  # whether it makes no sense for tasks without phases
    # whether it changes a policy's memory: who has one is known after the first world
    of_memory: bool = False


INTERVENTIONS: Mapping[Intervention, Rule] = {
    "swap": Rule(
        lambda of: [of.world("swap", swap, {"swap_cue": swap}) for swap in of.settings.swaps],
        "no other cue was asked for",
        needs_phases=False,
    ),
    "order": Rule(
        lambda of: [
            of.world("order", swap, {"swap_order": swap})
            for swap in of.settings.swaps
            if of.spec.shows_one_by_one
        ],
        "its cue is not shown one item after another",
        needs_phases=False,
    ),
    "blank": Rule(
        lambda of: [of.world("blank", None, {"show_cue": False})],
        "it has no cue phase",
        "with a blank cue in",
    ),
    "freeze": Rule(
        lambda of: [of.world("freeze", None, cue_view="first_frame")],
        "it has no cue phase",
        "with the first frame of the cue throughout in",
    ),
    "mask": Rule(TaskWorlds.masked, "it has no cue phase, or a mask that comes later needs a delay"),
    "shuffle": Rule(
        lambda of: (
            [of.world("shuffle", None, {"shuffle_cue": True})]
            if of.spec.shows_one_by_one and of.phases.n_in_turn > 1
            else []
        ),
        "its cue is not several items one after another",
        "with the items shown in another order than is right in",
        needs_phases=False,
    ),
    "late": Rule(TaskWorlds.late, "it has no cue phase", "with a cue that begins at step {level} in"),
    "cue": Rule(
        lambda of: of.of_lengths("cue", of.settings.cues),
        "it has no cue phase",
        "with a cue of {level} steps in",
    ),
    "delay": Rule(
        lambda of: of.of_lengths("delay", of.settings.delays),
        "it has no delay",
        "after a delay of {level} steps in",
    ),
    "delay_swap": Rule(TaskWorlds.swapped_after_delays, "it has no delay"),
    "distractor": Rule(
        TaskWorlds.distracted,
        "it has no items, or its delay is shorter than the distractor",
        "with a distractor for {level} steps in",
    ),
    "interference": Rule(
        lambda of: (
            [of.world("interference", None, {"move_in_delay": True})]
            if of.phases.delay_steps >= LEAST_MOTION_STEPS
            else []
        ),
        "it has no delay of two steps or more",
        "after a motion of the arm in the delay in",
    ),
    "reset": Rule(
        lambda of: [
            of.world("reset", step, reset_policy_at_step=step)
            for step in of.steps_of(of.settings.reset_steps)
        ],
        "it has no phases; name the steps with --reset-at",
        "after a reset of its memory at step {level} in",
        needs_phases=False,
    ),
    "instruction": Rule(
        lambda of: [
            of.world("instruction", Path(name).stem, prompt_set=name)
            for name in of.settings.instructions
            if name != of.config.prompt_set
        ],
        "the only prompt set that was named is that of the evaluation",
        "with the instructions '{level}' in",
        needs_phases=False,
    ),
    "appearance": Rule(
        lambda of: [
            of.world("appearance", name, appearance=APPEARANCES[name])
            for name in of.settings.appearances
            if of.config.simulator != "fake"
        ],
        "no change of appearance was named, or the simulator has none",
        "with another {level} in",
        needs_phases=False,
    ),
    "transplant": Rule(
        TaskWorlds.transplanted,
        NO_MEMORY,
        "with the memory of the swapped cue {level} put in at the response in",
        of_memory=True,
    ),
    "carry_over": Rule(
        lambda of: of.changed("carry_over", at_step=0),
        NO_MEMORY,
        "beginning with the memory that the episode before left in",
        of_memory=True,
    ),
    "memory_noise": Rule(
        lambda of: [w for d in of.settings.noises for w in of.changed("memory_noise", f"{d:g}", dose=d)],
        NO_MEMORY,
        "with noise of {level} standard deviations in its memory in",
        of_memory=True,
    ),
    "hold_memory": Rule(
        lambda of: [
            w
            for step in of.steps_of(of.settings.hold_steps)
            for w in of.changed("hold_memory", step, at_step=step)
        ],
        NO_MEMORY,
        "with the memory of step {level} from there on in",
        of_memory=True,
    ),
    "stale_memory": Rule(
        lambda of: [
            w for age in of.settings.ages for w in of.changed("stale_memory", age, at_step=0, age_steps=age)
        ],
        NO_MEMORY,
        "with its memory of {level} steps before in",
        of_memory=True,
    ),
    "erase_memory": Rule(
        TaskWorlds.erased,
        "no policy has such a part of its memory",
        "without '{level}' of its memory at the response in",
        of_memory=True,
    ),
}


def named_world(name: str) -> ProbedWorld | None:
    """Return the world that is called so, after its task; None if it is not the name of one."""
    for intervention in sorted((AS_DRAWN, *INTERVENTIONS), key=len, reverse=True):  # `delay_swap` first
        if name == intervention or name.startswith(f"{intervention}_"):
            text = name.removeprefix(intervention).removeprefix("_")
            level = None if not text else int(text) if text.isdecimal() else text
            return ProbedWorld(change=intervention, level=level)
    return None


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """The evaluations of a probe, and what makes no sense for a task, for a message."""

    worlds: tuple[World, ...]
    left_out: tuple[str, ...]


def plan_probe(
    config: EvalConfig,
    settings: ProbeSettings,
    *,
    memories: Mapping[str, Mapping[str, tuple[str, ...]]] | None = None,
) -> Probe:
    """Return the evaluations of a probe: the configured one, in each world that the settings name.

    Args:
        config: the configured evaluation.
        settings: which worlds.
        memories: task -> policy of the configuration -> the parts of its memory. None: not known yet, so that
            the worlds with a changed memory are not among those that are returned.
    """
    refuse_own_arguments(config)
    worlds: list[World] = []
    left_out: list[str] = []
    for task in config.tasks:
        spec = robot_task(task, does="`probe` changes")
        known = None if memories is None else memories.get(spec.id, {})
        of_task = TaskWorlds(spec=spec, config=config, settings=settings, memories=known)
        changed: list[World] = []
        # Whether the world as drawn is needed, to know who remembers and what.
        is_asked = settings.decodes and of_task.has_phases
        for probe in settings.probes:
            rule = INTERVENTIONS[probe]
            is_possible = of_task.has_phases or not rule.needs_phases
            found = rule.worlds(of_task) if is_possible else []
            changed += found
            if is_possible and rule.of_memory and known is None:
                is_asked = True
            elif not any(world.intervention == probe for world in found):
                why = rule.why_not if is_possible or not rule.of_memory else "it has no phases"
                left_out.append(f"{probe} on {spec.id}: {why}")
        if changed or is_asked:
            # By name: `delay_swap` has the worlds of `swap` and `delay` that it is compared with.
            worlds += {one.config.name: one for one in (of_task.world(AS_DRAWN, None), *changed)}.values()
    if not worlds and memories is None:
        raise RecipeError(f"--probe: there is nothing to run ({'; '.join(left_out)}).")
    return Probe(worlds=tuple(worlds), left_out=tuple(left_out))


def plan_later(
    config: EvalConfig, settings: ProbeSettings, first: Probe, out: Path, name_of: Callable[[str], str]
) -> Probe:
    """Return the worlds with a changed memory, and what makes no sense: known once the first were run.

    Args:
        config: as for `plan_probe`.
        settings: as for `plan_probe`.
        first: what `plan_probe` has returned.
        out: the folder of the run folders.
        name_of: what records call a policy of the configuration.
    """
    if not any(INTERVENTIONS[probe].of_memory for probe in settings.probes):
        return Probe(worlds=(), left_out=())
    memories: dict[str, Mapping[str, tuple[str, ...]]] = {}
    unknown: list[str] = []
    for world in first.worlds:
        if world.intervention == AS_DRAWN:
            found = read_run(out / world.config.name).description.memories
            named = {policy: name_of(policy) for policy in config.policies}
            memories[world.task] = {policy: found[name] for policy, name in named.items() if name in found}
            unknown += [
                f"{name} on {world.task}, worlds with a changed memory: whether it has one is not known: in "
                f"{out / world.config.name} no episode has ended yet, or an earlier version has run it. "
                "Remove that folder to run it again."
                for name in named.values()
                if name not in found
            ]
    later = plan_probe(config, settings, memories=memories)
    names = {world.config.name for world in first.worlds}
    return Probe(
        worlds=tuple(world for world in later.worlds if world.config.name not in names),
        left_out=(*unknown, *(line for line in later.left_out if line not in first.left_out)),
    )


def refuse_own_arguments(config: EvalConfig) -> None:
    """Raise `RecipeError` if a configuration sets what a probe sets itself."""
    for name in OWN_ARGUMENTS:
        if name in config.env:
            raise RecipeError(
                f"env.{name}: a probe sets this argument itself. `mikasa-vla eval` lets you set it."
            )
    for name, as_drawn in OWN_FIELDS.items():
        if getattr(config, name) != as_drawn:
            raise RecipeError(
                f"{name}: a probe sets this field itself. `mikasa-vla eval` lets you set it; --reset-at, "
                "--mask and --appearance choose what a probe sets."
            )
