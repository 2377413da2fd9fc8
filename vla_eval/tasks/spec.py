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
            measured (there is no choice among candidates).
        max_reward: the dense reward at success, which `normalized_dense` divides by.
        idle_success: how often doing nothing succeeds, as measured; 0 for all tasks but a few.
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

    @property
    def gym_id(self) -> str:
        """The id under which Gymnasium knows the task."""
        return f"vla_eval/{self.id}"
