"""What is known of a task without starting it: one `TaskSpec` per task id."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

MemoryType = Literal["object", "spatial", "sequential", "capacity"]
"""The paper's four types of memory (section on task classification)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskSpec:
    """One row of the catalogue.

    Attributes:
        id: task id without namespace, `RememberColor3-v0`; the gym id is `vla_eval/<id>`.
        version: raised when a change moves a success rate; recorded with each run.
        entry_point: `module:Class` of the ManiSkill environment.
        kwargs: arguments that make this row of its family; a user's arguments go on top.
        horizon_steps: the episode ends after so many control steps of 20 Hz.
        memory: which kind of memory the paper says it needs.
        instruction_key: the task's name in `prompts/*.yaml`.
        description: one sentence: what must be done.
        success: one sentence: the success rule.
        oracle: `module:attribute` of the scripted expert.
        oracle_sees: what the expert may see, and when it acts, in words.
        candidates: what the N things are among which the policy chooses; None if there is no choice.
        chance_success: success rate of a perfect arm that ignores the cue; None where it has to be
            measured (there is no choice among candidates), or depends on the arguments (families).
        max_reward: the dense reward at success, which `normalized_dense` divides by.
        idle_success: how often doing nothing succeeds, as measured; 0 for all tasks but a few.
        cue_marks_place: the cue is shown where the right candidate will be.
        shows_one_by_one: the cue is `n_shown` items one after another, each for `cue_steps`.
        open_arguments: what has to be chosen to make a task of this row; empty except for a family.
        min_response_steps: of a family: the horizon grows with cue and delay so that at least so many
            steps are left for the response. None: the horizon is fixed by the id.
    """

    id: str
    version: int
    entry_point: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    horizon_steps: int
    memory: MemoryType
    instruction_key: str
    description: str
    success: str
    oracle: str
    oracle_sees: str
    candidates: str | None
    chance_success: float | None
    max_reward: float
    idle_success: float = 0.0
    cue_marks_place: bool = False
    shows_one_by_one: bool = False
    open_arguments: tuple[str, ...] = ()
    min_response_steps: int | None = None

    @property
    def gym_id(self) -> str:
        """The id under which Gymnasium knows the task."""
        return f"vla_eval/{self.id}"

    def default_horizon_steps(self, longest_wait_steps: int) -> int:
        """Return how long an episode is, given how long cue and delay can be, where nobody says otherwise."""
        if self.min_response_steps is None:
            return self.horizon_steps
        return max(self.horizon_steps, longest_wait_steps + self.min_response_steps)


def total_cue_steps(cue_steps: int, n_in_turn: int, gap_steps: int) -> int:
    """Return how long a cue lasts.

    Args:
        cue_steps: how long each item is shown.
        n_in_turn: how many items are shown one after another; 1 if all are shown at once.
        gap_steps: steps between two of them.
    """
    return n_in_turn * cue_steps + (n_in_turn - 1) * gap_steps
