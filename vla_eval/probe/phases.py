"""When the phases of a task begin, by its arguments, and which inferences of a policy fall into them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from vla_eval.errors import RecipeError
from vla_eval.tasks.spec import TaskSpec, total_cue_steps

CUE_STEPS, DELAY_STEPS = 5, 5


def default_delay_steps(spec: TaskSpec) -> int:
    """Return the default of `delay_steps`: only the shell game, whose cue marks the place, has another."""
    return 0 if spec.cue_marks_place else DELAY_STEPS


@dataclass(frozen=True, slots=True, kw_only=True)
class Phases:
    """The phases of a task whose lengths are not drawn per episode."""

    cue_after_steps: int
    cue_steps: int  # control steps for which the cue, or each of its items, is shown
    n_in_turn: int  # how many items are shown one after another; 1 if all are shown at once
    gap_steps: int  # steps between two of them
    delay_steps: int  # steps between cue and response
    horizon_steps: int

    @property
    def cue_end_step(self) -> int:
        """The first step after the cue."""
        return self.cue_after_steps + total_cue_steps(self.cue_steps, self.n_in_turn, self.gap_steps)

    @property
    def response_step(self) -> int:
        """The first step of the response."""
        return self.cue_end_step + self.delay_steps

    def shows_at(self, step: int) -> bool:
        """Whether a cue is in view at this step."""
        turn_steps = self.cue_steps + self.gap_steps
        since = step - self.cue_after_steps
        return since >= 0 and step < self.cue_end_step and since % turn_steps < self.cue_steps

    def with_length(self, phase: Literal["cue", "delay"], steps: int) -> dict[str, int]:
        """Return the arguments that give a phase this length, and the response as many steps as before."""
        usual, n_times = (self.cue_steps, self.n_in_turn) if phase == "cue" else (self.delay_steps, 1)
        horizon_steps = self.horizon_steps + n_times * (steps - usual)
        return {f"{phase}_steps": steps, "horizon_steps": horizon_steps}


def phases_of(spec: TaskSpec, env: Mapping[str, Any]) -> Phases | str | None:  # Any: a task's arguments
    """Return the phases of a task, None if it has none, or the argument by which a length is drawn."""
    if spec.candidates is None:
        return None
    usual = {"cue_steps": CUE_STEPS, "delay_steps": default_delay_steps(spec)}
    given = {**usual, "gap_steps": 0, "cue_after_steps": 0, **spec.kwargs, **env}
    for name in ("cue_after_steps", "cue_steps", "delay_steps", "gap_steps", "horizon_steps"):
        if name in given and (not isinstance(given[name], int) or isinstance(given[name], bool)):
            return name
    n_in_turn = int(given["n_shown"]) if spec.shows_one_by_one else 1
    cue_steps = total_cue_steps(given["cue_steps"], n_in_turn, given["gap_steps"])
    wait_steps = given["cue_after_steps"] + cue_steps + given["delay_steps"]
    return Phases(
        cue_after_steps=given["cue_after_steps"],
        cue_steps=given["cue_steps"],
        n_in_turn=n_in_turn,
        gap_steps=given["gap_steps"],
        delay_steps=given["delay_steps"],
        horizon_steps=given.get("horizon_steps", spec.default_horizon_steps(wait_steps)),
    )


def fixed_phases(spec: TaskSpec, env: Mapping[str, Any]) -> Phases:  # Any: a task's arguments
    """Return the phases of a task that has some; refuse a length that is drawn per episode."""
    phases = phases_of(spec, env)
    if isinstance(phases, str):
        raise RecipeError(
            f"env.{phases}={env[phases]!r}: a probe that changes a phase, or resets the policy at the end of "
            "one, needs phases of a fixed length. Give one number, or leave these probes out."
        )
    assert phases is not None  # only asked of tasks with candidates, which have phases
    return phases


def n_cue_frames_after(phases: Phases, interval_steps: int) -> int:
    """Return how many frames of the cue a policy is shown after a change of its memory at the response.

    The change is made before the first inference of the response, at which a policy that reads every frame is
    shown those since the inference before.
    """
    late = (-phases.response_step) % interval_steps
    before = phases.response_step + late - interval_steps
    return sum(phases.shows_at(step) for step in range(max(before + 1, 0), phases.cue_end_step))


def divides(phases: Phases, n_action_steps: int) -> bool:
    """Whether each phase, and each item of the cue, begins with an inference if the first one is at 0."""
    turn_steps = phases.cue_steps + phases.gap_steps
    begins = [phases.cue_after_steps, phases.cue_end_step, phases.response_step]
    begins += [turn_steps] if phases.n_in_turn > 1 else []
    return all(step % n_action_steps == 0 for step in begins)


class Inferences(NamedTuple):
    """Which inferences of a policy fall into the cue, and how late the first one of the response is."""

    # the steps of the cue at which the policy infers; a policy that reads only the last frame sees no
    # other frame of the cue
    cue_steps: tuple[int, ...]
    n_late: int  # steps of the response whose actions were predicted before it began


def inferences(
    phases: Phases, interval_steps: int, *, first_inference_step: int = 0, delay_steps: int = 0
) -> Inferences:
    """Return the inferences, one per interval, that matter to the cue and to the response."""
    steps = range(first_inference_step, phases.cue_end_step, interval_steps)
    return Inferences(
        cue_steps=tuple(step for step in steps if phases.shows_at(step)),
        n_late=(first_inference_step - phases.response_step) % interval_steps + delay_steps,
    )
