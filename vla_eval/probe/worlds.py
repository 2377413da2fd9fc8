"""The worlds of a probe: a task with one thing changed (cue, delay, the policy's memory …), same seeds."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from vla_eval.config.environment import AppearanceSettings
from vla_eval.config.evaluation import EvalConfig, ProbedWorld
from vla_eval.cue_view import CueViewKind
from vla_eval.memory_change import MemoryChange, MemoryChangeKind
from vla_eval.probe.phases import Phases, default_delay_steps, fixed_phases
from vla_eval.tasks.spec import TaskSpec

Intervention = str
"""`AS_DRAWN`, or a key of `interventions.INTERVENTIONS`."""
AS_DRAWN: Intervention = "none"
WITHOUT_MEMORY: Intervention = "no memory"
"""In place of one, in the row of a policy without a memory that could be changed."""
AT_RESPONSE: tuple[Intervention, ...] = ("transplant", "memory_noise", "erase_memory")
"""Interventions that change the memory once, before the first inference of the response."""
SWAPS: tuple[Intervention, ...] = ("swap", "order", "delay_swap")
"""Interventions whose worlds have another right answer than the world that they are compared with."""

Level = int | str | None
"""By how much a world is changed: a number, or a name; None where there is nothing to count."""

CONTROLS = ("oracle", "cue_blind")
CONTROLS_OF_ONE = ("body_memory",)
"""Controls that need a single right candidate."""

ITEMS = ("items", "cubes")
"""Kinds of candidates that can be shown, and so can distract."""

MASKS: Mapping[str, CueViewKind] = {"cue": "hidden", "elsewhere": "hidden_elsewhere", "later": "hidden_later"}
"""What of the image is hidden: the cue, as much of the same frames, the same place in the delay."""

APPEARANCES: Mapping[str, AppearanceSettings] = {
    "light": AppearanceSettings(light=0.6),
    "camera": AppearanceSettings(camera_shift_m=0.03, camera_turn_deg=3.0),
    "table": AppearanceSettings(table_rgb=(0.5, 0.5, 0.5)),
    "hue": AppearanceSettings(hue_deg=10.0),
}
"""Changes that leave each colour nearer to itself than to any other of the nine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeSettings:
    """What a probe changes; see `interventions.INTERVENTIONS`, of which `probes` are keys."""

    probes: tuple[Intervention, ...] = ("swap", "blank", "delay", "reset")
    swaps: tuple[int, ...] = (1,)  # values of `env.swap_cue`, and of `env.swap_order` for `order`
    # `delays`, `cues`, `lates`, `distractors`: values of `env.delay_steps`, `env.cue_steps`,
    # `env.cue_after_steps` and `env.distract_steps`
    delays: tuple[int, ...] = (0, 5, 10, 20, 40, 80, 160, 320)
    cues: tuple[int, ...] = (1, 2, 3)
    # `masks`, `appearances`: keys of `MASKS` and `APPEARANCES`
    masks: tuple[str, ...] = tuple(MASKS)
    lates: tuple[int, ...] = (5, 20)
    appearances: tuple[str, ...] = tuple(APPEARANCES)
    distractors: tuple[int, ...] = (3,)
    instructions: tuple[str, ...] = ("paraphrased", "other_task", "no_content")  # prompt sets
    # control steps at which the policy is reset; none: the end of the cue, and the beginning of the
    # response if that is later
    reset_steps: tuple[int, ...] = ()
    noises: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)  # doses, in standard deviations of each array
    hold_steps: tuple[int, ...] = ()  # from which control steps on a memory is held; none: as `reset_steps`
    ages: tuple[int, ...] = (5, 10, 20)  # of a stale memory, control steps
    erased: tuple[str, ...] = ()  # parts of a memory; none: each of its parts
    decodes: bool = False  # whether linear probes ask what is in the memory, in the world as drawn
    controls: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """One evaluation of a probe."""

    task: str
    # what is changed; `none` for the world that the others are compared with. `delay_swap` is compared
    # with the `delay` of the same level.
    intervention: Intervention
    # by how much: the swap's number, a number of steps, the step of a reset, or a prompt set
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
class TaskWorlds:
    """The worlds of one task."""

    spec: TaskSpec
    config: EvalConfig
    settings: ProbeSettings
    # policy of the configuration -> the parts of its memory, none if it has none; None: not known before the
    # world as drawn has been run
    memories: Mapping[str, tuple[str, ...]] | None = None

    @property
    def has_phases(self) -> bool:
        """Whether the task has phases, in which something can be changed."""
        return self.spec.candidates is not None

    @property
    def phases(self) -> Phases:
        """The phases of the world as drawn; only asked of tasks with phases."""
        return fixed_phases(self.spec, self.config.env)

    def of_lengths(self, phase: Literal["cue", "delay"], lengths: tuple[int, ...]) -> list[World]:
        """Return the worlds in which a phase has another length, with as many steps for the response."""
        phases = self.phases
        usual = phases.cue_steps if phase == "cue" else phases.delay_steps
        others = sorted(set(lengths) - {usual})
        return [self.world(phase, steps, phases.with_length(phase, steps)) for steps in others]

    def swapped_after_delays(self) -> list[World]:
        """Return the worlds of each delay, as drawn and with the first of the other cues."""
        delays, swap = self.of_lengths("delay", self.settings.delays), self.settings.swaps[0]
        swapped = [
            self.world("delay_swap", world.level, {**world.config.env, "swap_cue": swap}) for world in delays
        ]
        return [self.world("swap", swap, {"swap_cue": swap}), *delays, *swapped]

    def masked(self) -> list[World]:
        """Return the worlds in which a part of the image is hidden, in the delay only if there is one."""
        has_delay = self.phases.delay_steps > 0
        masks = [mask for mask in self.settings.masks if mask != "later" or has_delay]
        return [self.world("mask", mask, cue_view=MASKS[mask]) for mask in masks]

    def late(self) -> list[World]:
        """Return the worlds in which nothing is shown before the cue, with as many steps after it."""
        usual, lates = self.phases.horizon_steps, self.settings.lates
        envs = [{"cue_after_steps": steps, "horizon_steps": usual + steps} for steps in lates]
        return [self.world("late", *late) for late in zip(lates, envs, strict=True)]

    def distracted(self) -> list[World]:
        """Return the worlds with another item in the delay, if the delay is long enough."""
        longest = self.phases.delay_steps if self.spec.candidates in ITEMS else 0
        lengths = [length for length in self.settings.distractors if length <= longest]
        return [self.world("distractor", length, {"distract_steps": length}) for length in lengths]

    def steps_of(self, asked: tuple[int, ...]) -> tuple[int, ...]:
        """Return the steps at which something is done: those asked for, or the ends of phases."""
        if asked or not self.has_phases:
            return asked
        return tuple(dict.fromkeys((self.phases.cue_end_step, self.phases.response_step)))

    def transplanted(self) -> list[World]:
        """Return the worlds with swapped cues, and those in which the memory of these is put in."""
        swaps = [{"swap_cue": swap} for swap in self.settings.swaps]
        return [
            *(self.world("swap", swap["swap_cue"], swap) for swap in swaps),
            *(w for swap in swaps for w in self.changed("transplant", swap["swap_cue"], donor_env=swap)),
        ]

    def erased(self) -> list[World]:
        """Return the worlds in which one part of the memory is missing, of the policies that have it."""
        known = {part for parts in (self.memories or {}).values() for part in parts}
        parts = sorted(known & set(self.settings.erased or known))
        return [w for part in parts for w in self.changed("erase_memory", part, part=part)]

    def changed(
        self, kind: MemoryChangeKind, level: Level = None, *, at_step: int | None = None, **change: Any
    ) -> list[World]:
        """Return the world with a changed memory, of the policies that have one; none if no policy has."""
        part = change.get("part")
        policies = [
            policy for policy, parts in (self.memories or {}).items() if parts and part in (None, *parts)
        ]
        if not policies:
            return []
        moment = self.phases.response_step if at_step is None else at_step
        changed = MemoryChange(kind=kind, at_step=moment, **change)
        world = self.world(kind, level, memory_change=changed)
        return [replace(world, config=replace(world.config, policies=tuple(policies)))]

    def world(
        self,
        intervention: Intervention,
        level: Level,
        env: Mapping[str, object] | None = None,
        **fields: Any,  # Any: other fields of `EvalConfig`
    ) -> World:
        """Return the world with these arguments of the task, and fields of the evaluation, changed."""
        policies = [*self.config.policies]
        if self.settings.controls:
            policies += [control for control in self._controls() if control not in policies]
        # Written out, so that this world is one level of the delay whatever the simulator's default is.
        delay = {"delay_steps": default_delay_steps(self.spec)} if self.has_phases else {}
        decodes = self.settings.decodes and intervention == AS_DRAWN
        config = replace(
            self.config,
            capture=replace(self.config.capture, memory=True) if decodes else self.config.capture,
            # A part of a memory has a name with a slash.
            name="_".join(
                [self.spec.id, intervention, *([] if level is None else [str(level).replace("/", ".")])]
            ),
            tasks=(self.spec.id,),
            policies=tuple(policies),
            env={**delay, **self.config.env, **(env or {})},
            world=ProbedWorld(change=intervention, level=level),
            **fields,
        )
        return World(task=self.spec.id, intervention=intervention, level=level, config=config)

    def _controls(self) -> tuple[str, ...]:
        shows_several = "n_shown" in (*self.spec.kwargs, *self.spec.open_arguments)
        return (*CONTROLS, *CONTROLS_OF_ONE) if self.has_phases and not shows_several else CONTROLS


def delay_of(config: EvalConfig) -> int | None:
    """Return the delay of a world; None for a task without one, or if it is drawn per episode."""
    delay = config.env.get("delay_steps")
    return delay if isinstance(delay, int) else None
