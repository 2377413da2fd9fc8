"""What is known about a task without starting a simulator: one `TaskSpec` per task id."""

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
        version: raised when a change affects a success rate; recorded with each run.
        entry_point: `module:Class` of the ManiSkill environment.
        kwargs: arguments that make this row of its family; a user's arguments override them.
        horizon_steps: number of control steps, at 20 Hz, after which the episode ends.
        memory: the type of memory that it needs, according to the paper.
        instruction_key: the task's name in `prompts/*.yaml`.
        description: one sentence: the goal.
        success: one sentence: the success rule.
        oracle: `module:attribute` of the scripted expert.
        oracle_sees: what the expert may see, and when it acts, in words.
        candidates: the kind of the N objects among which the policy chooses; None if there is no choice.
        chance_success: success rate of a perfect arm that ignores the cue; None if it has to be measured
            (there is no choice among candidates), or depends on the arguments (families).
        max_reward: the dense reward at success, by which `normalized_dense` divides.
        idle_success: measured success rate of doing nothing; 0 for all tasks but a few.
        cue_marks_place: the cue is shown where the right candidate will be.
        shows_one_by_one: the cue is `n_shown` items one after another, each for `cue_steps`.
        open_arguments: arguments required to make a task of this row; empty except for a family.
        min_response_steps: of a family: the horizon grows with cue and delay so that at least this many
            steps remain for the response. None: the horizon is fixed by the id.
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
        """Return the default length of an episode, given the maximum length of cue and delay."""
        if self.min_response_steps is None:
            return self.horizon_steps
        return max(self.horizon_steps, longest_wait_steps + self.min_response_steps)


def total_cue_steps(cue_steps: int, n_in_turn: int, gap_steps: int) -> int:
    """Return the length of a cue.

    Args:
        cue_steps: steps for which each item is shown.
        n_in_turn: how many items are shown one after another; 1 if all are shown at once.
        gap_steps: steps between two of them.
    """
    return n_in_turn * cue_steps + (n_in_turn - 1) * gap_steps
