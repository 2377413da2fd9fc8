"""When the phases of a task begin, by its arguments, and which of a policy's inferences fall into them.

Knows nothing of simulators: their defaults are written down here, and a test compares.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from vla_eval.tasks.spec import TaskSpec, total_cue_steps

CUE_STEPS = 5
DELAY_STEPS = 5
SHELL_GAME_DELAY_STEPS = 0


def default_delay_steps(spec: TaskSpec) -> int:
    """Return the default of `delay_steps`: only the shell game, whose cue marks the place, has another."""
    return SHELL_GAME_DELAY_STEPS if spec.cue_marks_place else DELAY_STEPS


@dataclass(frozen=True, slots=True, kw_only=True)
class Phases:
    """The phases of a task whose lengths are not drawn per episode.

    Attributes:
        cue_steps: control steps for which the cue, or each of its items, is shown.
        n_in_turn: how many items are shown one after another; 1 if all are shown at once.
        gap_steps: steps between two of them.
        delay_steps: steps between cue and response.
        horizon_steps: length of the episode.
    """

    cue_steps: int
    n_in_turn: int
    gap_steps: int
    delay_steps: int
    horizon_steps: int

    @property
    def cue_end_step(self) -> int:
        """The first step after the cue."""
        return total_cue_steps(self.cue_steps, self.n_in_turn, self.gap_steps)

    @property
    def response_step(self) -> int:
        """The first step of the response."""
        return self.cue_end_step + self.delay_steps


def phases_of(spec: TaskSpec, env: Mapping[str, Any]) -> Phases | str | None:  # Any: a task's arguments
    """Return the phases of a task with these arguments.

    Returns:
        None for a task without phases; the name of an argument that is not one number.
    """
    if spec.candidates is None:
        return None
    given = {
        "cue_steps": CUE_STEPS,
        "delay_steps": default_delay_steps(spec),
        "gap_steps": 0,
        **spec.kwargs,
        **env,
    }
    for name in ("cue_steps", "delay_steps", "gap_steps", "horizon_steps"):
        if name in given and (not isinstance(given[name], int) or isinstance(given[name], bool)):
            return name
    n_in_turn = int(given["n_shown"]) if spec.shows_one_by_one else 1
    wait_steps = total_cue_steps(given["cue_steps"], n_in_turn, given["gap_steps"]) + given["delay_steps"]
    return Phases(
        cue_steps=given["cue_steps"],
        n_in_turn=n_in_turn,
        gap_steps=given["gap_steps"],
        delay_steps=given["delay_steps"],
        horizon_steps=given.get("horizon_steps", spec.default_horizon_steps(wait_steps)),
    )


class Inferences(NamedTuple):
    """Which inferences of a policy fall into the cue, and how late the first one of the response is.

    Attributes:
        cue_steps: the steps of the cue at which the policy infers; a policy that reads only the last frame
            sees no other frame of the cue.
        n_late: steps of the response whose actions were predicted before it began.
    """

    cue_steps: tuple[int, ...]
    n_late: int


def inferences(phases: Phases, n_action_steps: int) -> Inferences:
    """Return the inferences at steps 0, K, 2K, … that matter to the cue and to the response."""
    return Inferences(
        cue_steps=tuple(range(0, phases.cue_end_step, n_action_steps)),
        n_late=-phases.response_step % n_action_steps,
    )
