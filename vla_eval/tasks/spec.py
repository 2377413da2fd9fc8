"""A task without its simulator: one `TaskSpec` per task id, and the arithmetic of phases and chance."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from vla_eval.errors import TaskArgumentError

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

Suite = Literal["paper", "objects", "mikasa_vla_90", "mikasa_official", "mikasa_base", "real_twin"]
"""Own tasks of the paper's table, and those that other packages add; own tasks with everyday things, which
the paper shows; the official package's 90; its original ones; MIKASA-Base; the stages on a real arm,
simulated."""

Split = Literal["short", "medium", "long"]
LONGEST_SHORT_STEPS, LONGEST_MEDIUM_STEPS = 200, 600  # of the official splits

PhaseSource = Literal["cue_and_delay", "cue", "none"]
"""Which of its phases an official environment shows to the outside: it has numbers of their steps."""

TrueState = Literal["items", "mugs", "ball", "peg", "cube", "none"]
"""What scripted controls can be given of an official environment: its candidates, or its moving object."""

MAX_CANDIDATES = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskSpec:
    """One row of the catalogue."""

    # task id: `RememberColor3-v0`, whose gym id is `vla_eval/<id>`; or with the namespace of its suite
    id: str
    version: int = 1  # raised when a change affects a success rate; recorded with each run
    entry_point: str  # `module:Class` of the ManiSkill environment
    # arguments that make this row of its family; a user's arguments override them
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    horizon_steps: int  # number of control steps, at 20 Hz, after which the episode ends
    memory: MemoryType  # the type of memory that it needs, according to the paper
    other_memory: tuple[MemoryType, ...] = ()  # further ones
    instruction_key: str  # the task's name in `prompts/*.yaml`
    description: str  # one sentence: the goal
    success: str  # one sentence: the success rule
    oracle: str  # `module:attribute` of the scripted expert
    oracle_sees: str  # what the expert may see, and when it acts, in words
    # the expert turns the wrist, so that it needs a control mode with rotations
    turns_wrist: bool = False
    # the kind of the N objects among which the policy chooses; None if there is no choice, and for an
    # official task
    candidates: str | None
    # argument -> its default; their product is N. Empty if there is no choice, or it is not known to
    # controls. A name that is not an argument of the task is a constant.
    candidate_counts: Mapping[str, int] = field(default_factory=dict)
    several_right: bool = False  # several candidates have to be touched; otherwise one is right
    # what the control of single frames goes by: a ball that rolls (with the argument
    # `velocity_range_m_s`), or a cube dragged onto a disc whose colour is known
    seen_in_one_frame: Literal["ball", "cube"] | None = None
    # success rate of a perfect arm that ignores the cue; None if it has to be measured (there is no
    # choice among candidates), or depends on the arguments (families)
    chance_success: float | None
    idle_success: float = 0.0  # measured success rate of doing nothing; 0 for all tasks but a few
    cue_marks_place: bool = False  # the cue is shown where the right candidate will be
    cue_leaves_out: bool = False  # the right candidate is the one that the cue does not show
    shows_one_by_one: bool = False  # the cue is `n_shown` items one after another, each for `cue_steps`
    # arguments required to make a task of this row; empty except for a family
    open_arguments: tuple[str, ...] = ()
    is_slow: bool = False  # 100 episodes take an hour: a run of its whole suite leaves it out, and says so
    lacks: tuple[str, ...] = ()  # adapters of controls that others of its suite have, and this task has not
    suite: Suite = "paper"  # the set of tasks that it belongs to
    # its sentence where no prompt set has one under `instruction_key`; a word in braces is filled in by
    # the environment, per episode. Empty: an episode has none.
    instruction: str | None = None
    # `phase_source`, `waits_for_choice`: of an official task: which phases can be read from it, and
    # whether the official wrapper replaces actions by zeros until the choice
    phase_source: PhaseSource = "none"
    waits_for_choice: bool = False
    # of an official task: what scripted controls can be given of its true state
    true_state: TrueState = "none"
    # of a family: the horizon grows with cue and delay so that at least this many steps remain for the
    # response. None: the horizon is fixed by the id.
    min_response_steps: int | None = None

    @property
    def gym_id(self) -> str:
        """The id under which Gymnasium knows the task: one episode in numpy, as an evaluation has it."""
        return self.id if "/" in self.id else f"vla_eval/{self.id}"

    @property
    def order_counts(self) -> bool:
        """Whether the right candidates have to be touched in the order in which they were shown."""
        return self.memory == "sequential"

    @property
    def maniskill_id(self) -> str:
        """The id of the ManiSkill environment behind it: batched, torch."""
        namespace, _, name = self.gym_id.partition("/")
        return f"{namespace}_maniskill/{name}"

    def make_vec(self, *, n_envs: int) -> str:
        """Return the call that makes several environments on a CPU, for messages."""
        return (
            f'gymnasium.make_vec("{self.gym_id}", num_envs={n_envs}, vectorization_mode="async", '
            'vector_kwargs={"context": "spawn"})'
        )

    @property
    def has_candidates(self) -> bool:
        """Whether one or more of N objects have to be chosen, and which they are is known to controls."""
        return bool(self.candidate_counts)

    @property
    def has_alike_candidates(self) -> bool:
        """Whether the candidates are mugs: nothing but their places distinguishes them."""
        return "mugs" in (self.candidates, self.true_state)

    @property
    def is_tracked(self) -> bool:
        """Whether the candidates change places after the cue, in view: each move has to be followed."""
        return "tracking" in self.memory_types

    @property
    def is_official(self) -> bool:
        """Whether it runs in the official package."""
        return self.suite in ("mikasa_vla_90", "mikasa_official")

    @property
    def is_base(self) -> bool:
        """Whether it is one of MIKASA-Base: without a robot, an instruction and candidates."""
        return self.suite == "mikasa_base"

    @property
    def memory_types(self) -> tuple[MemoryType, ...]:
        """All types of memory that it needs, the main one first."""
        return (self.memory, *self.other_memory)

    @property
    def split(self) -> Split | None:
        """The official split of the 90 tasks, by horizon; None for the others."""
        if self.suite != "mikasa_vla_90":
            return None
        if self.horizon_steps <= LONGEST_SHORT_STEPS:
            return "short"
        return "medium" if self.horizon_steps <= LONGEST_MEDIUM_STEPS else "long"

    def n_candidates(self, env_kwargs: Mapping[str, object]) -> int:
        """Return how many candidates there are with these arguments; 0 for a task without candidates.

        Raises:
            TaskArgumentError: an argument that counts them is not a number from 1 to 100.
        """
        given = {**self.candidate_counts, **self.kwargs, **env_kwargs}
        counts = {name: given[name] for name in self.candidate_counts}
        for name, count in counts.items():
            if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= MAX_CANDIDATES:
                raise TaskArgumentError(
                    f"{self.id}: {name}={count!r:.80}: expected a whole number, 1 to {MAX_CANDIDATES}."
                )
        return math.prod(counts.values()) if counts else 0

    def default_horizon_steps(self, longest_wait_steps: int) -> int:
        """Return the default length of an episode, given the maximum length of cue and delay."""
        if self.min_response_steps is None:
            return self.horizon_steps
        return max(self.horizon_steps, longest_wait_steps + self.min_response_steps)


def total_cue_steps(cue_steps: int, n_in_turn: int, gap_steps: int) -> int:
    """Return the length of a cue of `n_in_turn` items (1: all at once), each shown for `cue_steps`."""
    return n_in_turn * cue_steps + (n_in_turn - 1) * gap_steps


def chance_of_several(n_items: int, n_shown: int, *, in_order: bool) -> float:
    """Return the success rate of a perfect arm that knows how many items were shown, but not which."""
    return 1 / (math.perm(n_items, n_shown) if in_order else math.comb(n_items, n_shown))
