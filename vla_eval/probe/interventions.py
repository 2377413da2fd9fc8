"""The evaluations of a probe: one per task and world, on the same seeds.

A *world* is the task with one thing changed: the cue, the length of the delay, the policy's memory. Knows
nothing of records or statistics.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from vla_eval.config.appearance import AS_DESIGNED
from vla_eval.config.evaluation import EvalConfig
from vla_eval.cue_view import CueViewKind
from vla_eval.errors import RecipeError
from vla_eval.probe.phases import Phases, default_delay_steps, fixed_phases
from vla_eval.probe.views import APPEARANCES, MASKS
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.spec import TaskSpec

Intervention = Literal[
    "none",
    "swap",
    "order",
    "blank",
    "freeze",
    "mask",
    "shuffle",
    "late",
    "cue",
    "delay",
    "delay_swap",
    "distractor",
    "interference",
    "reset",
    "instruction",
    "appearance",
]
PROBES: tuple[Intervention, ...] = (
    *("swap", "order", "blank", "freeze", "mask", "shuffle", "late", "cue", "delay", "delay_swap"),
    *("distractor", "interference", "reset", "instruction", "appearance"),
)
SWAPS: tuple[Intervention, ...] = ("swap", "order", "delay_swap")
"""Interventions whose worlds have another right answer than the world that they are compared with."""
DEFAULT_PROBES: tuple[Intervention, ...] = ("swap", "blank", "delay", "reset")
DEFAULT_DELAYS = (0, 5, 10, 20, 40, 80, 160, 320)
DEFAULT_CUES = (1, 2, 3)
DEFAULT_DISTRACTORS = (3,)
DEFAULT_LATE = (5, 20)
DEFAULT_INSTRUCTIONS = ("paraphrased", "other_task", "no_content")

Level = int | str | None
"""By how much a world is changed: a number, or a name; None where there is nothing to count."""

CONTROLS = ("oracle", "cue_blind")
CONTROLS_OF_ONE = ("body_memory",)
"""Controls that need a single right candidate."""

ITEMS = ("items", "cubes")
"""Kinds of candidates that can be shown, and so can distract."""
LEAST_MOTION_STEPS = 2
"""One step out and one back."""
OWN_ARGUMENTS = (
    *("swap_cue", "swap_order", "show_cue", "shuffle_cue", "cue_after_steps", "distract_steps"),
    "move_in_delay",
)
OWN_FIELDS: Mapping[str, object] = {
    "reset_policy_at_step": None,
    "cue_view": "as_shown",
    "appearance": AS_DESIGNED,
}
"""Fields of an evaluation that a probe changes, and their values in the world as drawn."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeSettings:
    """What a probe changes.

    Attributes:
        probes: which interventions.
        swaps: values of `env.swap_cue`, and of `env.swap_order` for `order`.
        delays: values of `env.delay_steps`.
        cues: values of `env.cue_steps`.
        masks: keys of `MASKS`.
        lates: values of `env.cue_after_steps`.
        appearances: keys of `APPEARANCES`.
        distractors: values of `env.distract_steps`.
        instructions: prompt sets.
        reset_steps: control steps at which the policy is reset; none: the end of the cue, and the beginning
            of the response if that is later.
        controls: whether the controls are run with the policies.
    """

    probes: tuple[Intervention, ...] = DEFAULT_PROBES
    swaps: tuple[int, ...] = (1,)
    delays: tuple[int, ...] = DEFAULT_DELAYS
    cues: tuple[int, ...] = DEFAULT_CUES
    masks: tuple[str, ...] = tuple(MASKS)
    lates: tuple[int, ...] = DEFAULT_LATE
    appearances: tuple[str, ...] = tuple(APPEARANCES)
    distractors: tuple[int, ...] = DEFAULT_DISTRACTORS
    instructions: tuple[str, ...] = DEFAULT_INSTRUCTIONS
    reset_steps: tuple[int, ...] = ()
    controls: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """One evaluation of a probe.

    Attributes:
        task: task id.
        intervention: what is changed; `none` for the world that the others are compared with. `delay_swap`
            is compared with the `delay` of the same level.
        level: by how much: the swap's number, a number of steps, the step of a reset, or a prompt set.
        config: the evaluation of this task; its name is the run folder's.
    """

    task: str
    intervention: Intervention
    level: Level
    config: EvalConfig

    @property
    def label(self) -> str:
        """What is changed and by how much: `swap 1`."""
        return label_of(self.intervention, self.level)


def label_of(intervention: Intervention, level: Level) -> str:
    """Return what is changed in a world, and by how much."""
    return intervention if level is None else f"{intervention} {level}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """The evaluations of a probe, and what makes no sense for a task, for a message."""

    worlds: tuple[World, ...]
    left_out: tuple[str, ...]


def plan_probe(config: EvalConfig, settings: ProbeSettings) -> Probe:
    """Return the evaluations that a probe consists of.

    Args:
        config: tasks, policies, seeds and all that is the same in every world.
        settings: what is changed.

    Raises:
        UnknownNameError: a task that is not in the catalogue.
        RecipeError: the configuration sets what the probe sets itself, or nothing can be probed.
    """
    refuse_own_arguments(config)
    worlds: list[World] = []
    left_out: list[str] = []
    for task in config.tasks:
        spec = task_spec(task)
        of_task = _Task(spec=spec, config=config, settings=settings)
        changed: list[World] = []
        for probe in settings.probes:
            found = of_task.worlds(probe)
            changed += found
            if not found:
                left_out.append(f"{probe} on {spec.id}: {WHY_NOT[probe]}")
        if changed:
            # By name: `delay_swap` has the worlds of `swap` and `delay` that it is compared with.
            worlds += {one.config.name: one for one in (of_task.world("none", None, {}), *changed)}.values()
    if not worlds:
        raise RecipeError(f"--probe: there is nothing to run ({'; '.join(left_out)}).")
    return Probe(worlds=tuple(worlds), left_out=tuple(left_out))


WHY_NOT: Mapping[Intervention, str] = {
    "swap": "no other cue was asked for",
    "order": "its cue is not shown one item after another",
    "blank": "it has no cue phase",
    "freeze": "it has no cue phase",
    "mask": "it has no cue phase, or a mask that comes later needs a delay",
    "shuffle": "its cue is not several items one after another",
    "late": "it has no cue phase",
    "cue": "it has no cue phase",
    "delay": "it has no delay",
    "delay_swap": "it has no delay",
    "distractor": "it has no items, or its delay is shorter than the distractor",
    "interference": "it has no delay of two steps or more",
    "instruction": "the only prompt set that was named is that of the evaluation",
    "appearance": "no change of appearance was named, or the simulator has none",
    "reset": "it has no phases; name the steps with --reset-at",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Task:
    """One task of a probe."""

    spec: TaskSpec
    config: EvalConfig
    settings: ProbeSettings

    def worlds(self, probe: Intervention) -> list[World]:
        """Return the worlds of one intervention; none where it makes no sense."""
        has_phases, settings = self.spec.candidates is not None, self.settings
        if probe == "swap":
            return [self.world(probe, swap, {"swap_cue": swap}) for swap in settings.swaps]
        if probe == "order":
            swaps = settings.swaps if self.spec.shows_one_by_one else ()
            return [self.world(probe, swap, {"swap_order": swap}) for swap in swaps]
        if probe == "blank":
            return [self.world(probe, None, {"show_cue": False})] if has_phases else []
        if probe == "freeze":
            return [self._seeing(probe, None, "first_frame")] if has_phases else []
        if probe == "mask":
            return self._masking() if has_phases else []
        if probe == "shuffle":
            return self._shuffling()
        if probe == "late":
            return self._late() if has_phases else []
        if probe == "appearance":
            return self._looking()
        if probe == "cue":
            return self._of_lengths(probe, settings.cues) if has_phases else []
        if probe == "delay":
            return self._of_lengths(probe, settings.delays) if has_phases else []
        if probe == "delay_swap":
            return self._swapping_after_delays() if has_phases else []
        if probe == "distractor":
            return self._distracting() if has_phases else []
        if probe == "interference":
            is_long = has_phases and self._phases().delay_steps >= LEAST_MOTION_STEPS
            return [self.world(probe, None, {"move_in_delay": True})] if is_long else []
        if probe == "reset":
            return [self._resetting(step) for step in self._reset_steps()]
        names = [name for name in settings.instructions if name != self.config.prompt_set]
        return [self._instructed(name) for name in names]

    def _of_lengths(self, probe: Literal["cue", "delay"], lengths: tuple[int, ...]) -> list[World]:
        """Return the worlds in which a phase has another length, with as many steps for the response."""
        phases = self._phases()
        usual = phases.cue_steps if probe == "cue" else phases.delay_steps
        return [
            self.world(probe, length, phases.with_length(probe, length))
            for length in sorted(set(lengths) - {usual})
        ]

    def _swapping_after_delays(self) -> list[World]:
        """Return the worlds of each delay, as drawn and with the first of the other cues."""
        delays, swap = self.worlds("delay"), self.settings.swaps[0]
        swapped = [
            self.world("delay_swap", world.level, {**world.config.env, "swap_cue": swap}) for world in delays
        ]
        usual = self.world("swap", swap, {"swap_cue": swap})
        return [usual, *delays, *swapped]

    def _seeing(self, probe: Intervention, level: Level, view: CueViewKind) -> World:
        world = self.world(probe, level, {})
        return replace(world, config=replace(world.config, cue_view=view))

    def _masking(self) -> list[World]:
        has_delay = self._phases().delay_steps > 0
        masks = [mask for mask in self.settings.masks if mask != "later" or has_delay]
        return [self._seeing("mask", mask, MASKS[mask]) for mask in masks]

    def _shuffling(self) -> list[World]:
        if not self.spec.shows_one_by_one or self._phases().n_in_turn < 2:
            return []
        return [self.world("shuffle", None, {"shuffle_cue": True})]

    def _late(self) -> list[World]:
        horizon_steps = self._phases().horizon_steps
        return [
            self.world("late", steps, {"cue_after_steps": steps, "horizon_steps": horizon_steps + steps})
            for steps in self.settings.lates
        ]

    def _looking(self) -> list[World]:
        if self.config.simulator == "fake":
            return []
        return [self._looking_like(name) for name in self.settings.appearances]

    def _looking_like(self, name: str) -> World:
        world = self.world("appearance", name, {})
        return replace(world, config=replace(world.config, appearance=APPEARANCES[name]))

    def _distracting(self) -> list[World]:
        if self.spec.candidates not in ITEMS:
            return []
        longest = self._phases().delay_steps
        lengths = [length for length in self.settings.distractors if length <= longest]
        return [self.world("distractor", length, {"distract_steps": length}) for length in lengths]

    def _resetting(self, step: int) -> World:
        world = self.world("reset", step, {})
        return replace(world, config=replace(world.config, reset_policy_at_step=step))

    def _instructed(self, prompt_set: str) -> World:
        world = self.world("instruction", Path(prompt_set).stem, {})
        return replace(world, config=replace(world.config, prompt_set=prompt_set))

    def world(self, intervention: Intervention, level: Level, env: Mapping[str, int]) -> World:
        """Return the world in which these arguments of the task are changed."""
        policies = [*self.config.policies]
        if self.settings.controls:
            policies += [control for control in self._controls() if control not in policies]
        name = "_".join([self.spec.id, intervention, *([] if level is None else [str(level)])])
        # Written out, so that this world is one level of the delay whatever the simulator's default is.
        delay = {} if self.spec.candidates is None else {"delay_steps": default_delay_steps(self.spec)}
        return World(
            task=self.spec.id,
            intervention=intervention,
            level=level,
            config=replace(
                self.config,
                name=name,
                tasks=(self.spec.id,),
                policies=tuple(policies),
                env={**delay, **self.config.env, **env},
            ),
        )

    def _controls(self) -> tuple[str, ...]:
        shows_one = self.spec.candidates is not None and not shows_several(self.spec)
        return (*CONTROLS, *CONTROLS_OF_ONE) if shows_one else CONTROLS

    def _reset_steps(self) -> tuple[int, ...]:
        if self.settings.reset_steps or self.spec.candidates is None:
            return self.settings.reset_steps
        phases = self._phases()
        return tuple(dict.fromkeys((phases.cue_end_step, phases.response_step)))

    def _phases(self) -> Phases:
        """Return the phases of the world as drawn; only asked of tasks with phases."""
        return fixed_phases(self.spec, self.config.env)


def shows_several(spec: TaskSpec) -> bool:
    """Return whether several candidates are right."""
    return "n_shown" in (*spec.kwargs, *spec.open_arguments)


def delay_of(config: EvalConfig) -> int | None:
    """Return the delay of a world; None for a task without one, or if it is drawn per episode."""
    delay = config.env.get("delay_steps")
    return delay if isinstance(delay, int) else None


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
