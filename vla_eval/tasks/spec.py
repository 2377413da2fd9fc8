"""What is known about a task without starting a simulator: one `TaskSpec` per task id."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

MemoryType = Literal[
    "object",
    "spatial",
    "sequential",
    "capacity",
    "tracking",
    "negative",
    "temporal",
    "procedural",
    "prospective",
    "checklist",
]
"""The paper's four types of memory (section on task classification), then six that only the official 90 tasks
have."""

Suite = Literal["paper", "mikasa_vla_90", "mikasa_official"]
"""This package's own tasks; the official package's 90 tasks; its original ones."""

Split = Literal["short", "medium", "long"]
LONGEST_SHORT_STEPS, LONGEST_MEDIUM_STEPS = 200, 600  # of the official splits

PhaseSource = Literal["cue_and_delay", "cue", "none"]
"""Which of its phases an official environment shows to the outside: it has numbers of their steps."""

TrueState = Literal["items", "mugs", "ball", "peg", "cube", "none"]
"""What scripted controls can be given of an official environment: its candidates, or its moving object."""


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
        suite: the set of tasks that it belongs to.
        instruction: its sentence where no prompt set has one under `instruction_key`; a word in braces is
            filled in by the environment, per episode.
        phase_source, waits_for_choice: of an official task: which phases can be read from it, and whether the
            official wrapper replaces actions by zeros until the choice.
        true_state: of an official task: what scripted controls can be given of its true state.
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
    suite: Suite = "paper"
    instruction: str | None = None
    phase_source: PhaseSource = "none"
    waits_for_choice: bool = False
    true_state: TrueState = "none"
    min_response_steps: int | None = None

    @property
    def gym_id(self) -> str:
        """The id under which Gymnasium knows the task."""
        return f"vla_eval/{self.id}"

    @property
    def has_candidates(self) -> bool:
        """Whether one or more of N objects have to be chosen, and which they are is known to controls.

        `candidates` says so of this package's own tasks, whose phases have arguments.
        """
        return self.candidates is not None or self.true_state in ("items", "mugs")

    @property
    def seen_in_one_frame(self) -> Literal["ball", "cube"] | None:
        """What the control of single frames goes by: a ball that rolls, or a cube dragged onto a disc.

        The official TakeItBack is left out: its state does not say which colour the disc has.
        """
        if "velocity_range_m_s" in self.kwargs:
            return "ball"
        is_dragged = self.suite == "paper" and self.oracle.startswith("vla_eval.oracles.carry:")
        return "cube" if is_dragged else None

    @property
    def split(self) -> Split | None:
        """The official split of the 90 tasks, by horizon; None for the others."""
        if self.suite != "mikasa_vla_90":
            return None
        if self.horizon_steps <= LONGEST_SHORT_STEPS:
            return "short"
        return "medium" if self.horizon_steps <= LONGEST_MEDIUM_STEPS else "long"

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
