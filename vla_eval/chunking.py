"""Turn chunks of actions into one action per control step. Knows nothing of policies or simulators.

Time is counted in control steps since reset. A chunk inferred from the observation at step `s` holds
actions for steps `s, s + 1, …`. With a delay of `d` steps (`latency`) it arrives at step `s + d` and
replaces the one before. One inference runs at a time: the next begins `n_action_steps` steps after the last
one, or when that has arrived, if this is later. Until a chunk arrives, the one before continues; where that
has no action left, the arm holds still, and such a step is counted as held. The first inference is at step
`first_inference_step`, and the arm holds still until its chunk arrives.

What a chunk says about steps that are past when it arrives is dropped (`delay_alignment: skip`), as a robot
that keeps moving during inference must do; or the whole chunk is executed late (`stale`), which is what a
loop that does not know of its own latency does.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Literal, NamedTuple

import numpy as np

from vla_eval.core import ActionChunk, CommittedActions, FloatArray
from vla_eval.errors import RecipeError, SpecMismatchError
from vla_eval.latency import Delay, EpisodeDelays, VaryingDelay, longest_steps, shortest_steps
from vla_eval.strict.bounds import MAX_STEPS, Bounds, Steps, check_bounds
from vla_eval.strict.renamed import formerly

Mode = Literal["receding_horizon", "temporal_ensemble", "wait", "rtc", "prefix"]


class Execution(NamedTuple):
    """What is particular to one mode."""

    summary: str
    averages: bool = False  # the action of a step is the weighted mean of what all chunks say about it
    waits: bool = False  # the arm holds still during an inference; a chunk's first action is for its arrival
    commits: bool = False  # the policy gets what will be executed before its chunk can arrive
    is_guided: bool = False  # the new chunk is guided towards that, by `chunking.rtc`


EXECUTIONS: Mapping[Mode, Execution] = {
    "receding_horizon": Execution("the first n_action_steps actions of the newest chunk"),
    # Zhao et al. 2023 (ACT, arXiv:2304.13705), section IV-B, where the decay is called m.
    "temporal_ensemble": Execution("the weighted mean of all chunks", averages=True),
    "wait": Execution("the arm holds still while the policy thinks", waits=True),
    # Black et al. 2025 (arXiv:2506.07339).
    "rtc": Execution(
        "as receding_horizon; the new chunk is guided to join the old one", commits=True, is_guided=True
    ),
    # Black et al. 2025 (arXiv:2512.05964), "training-time RTC".
    "prefix": Execution("as rtc, by a policy that was trained to continue a prefix", commits=True),
}
"""One row per `chunking.mode`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RtcSettings:
    """How a chunk is guided to join the one before, in the mode `rtc`; the names are LeRobot's."""

    prefix_attention_schedule: Literal["zeros", "ones", "linear", "exp"] = "linear"
    max_guidance_weight: Annotated[float, Bounds(0)] = 10.0
    execution_horizon: Steps = 10  # how many rows, from the observed step on, have a weight

    def __post_init__(self) -> None:
        check_bounds(self, prefix="chunking.rtc.")


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkingSettings:
    """How chunks are executed, at any n_action_steps: the section `chunking` of an evaluation."""

    mode: Mode = "receding_horizon"
    # control steps from an observation to the arrival of its chunk, see `latency`
    delay: Delay = field(default=0, metadata=formerly("delay_steps"))
    delay_alignment: Literal["skip", "stale"] = "skip"
    ensemble_decay: Annotated[float, Bounds(0)] = 0.01  # the value of ACT's public code
    first_inference_step: Annotated[int, Bounds(0)] = 0
    rtc: RtcSettings = field(default_factory=RtcSettings)

    def __post_init__(self) -> None:
        self._check()

    def _check(self) -> None:
        check_bounds(self, prefix="chunking.")
        if isinstance(self.delay, int):
            check_bounds(self, {"delay": (0, MAX_STEPS)}, prefix="chunking.")
        if self.delay_alignment == "stale" and (self.execution.waits or self.execution.commits):
            raise RecipeError(
                f"chunking.delay_alignment is stale, expected skip with chunking.mode={self.mode}: in this "
                "mode a chunk is never executed late."
            )

    @property
    def execution(self) -> Execution:
        """What is particular to the mode."""
        return EXECUTIONS[self.mode]

    def at(self, n_action_steps: int) -> "ChunkingSpec":
        """Return the chunking at a number of action steps."""
        settings = {one.name: getattr(self, one.name) for one in fields(ChunkingSettings)}
        return ChunkingSpec(n_action_steps=n_action_steps, **settings)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkingSpec(ChunkingSettings):
    """How chunks are executed at one n_action_steps: what a policy and a rollout get.

    Raises:
        RecipeError: a value out of its range.
    """

    n_action_steps: Steps

    def __post_init__(self) -> None:
        self._check()
        if self.first_inference_step >= self.n_action_steps:
            raise RecipeError(
                f"chunking.first_inference_step is {self.first_inference_step}, expected less than "
                f"n_action_steps, which is {self.n_action_steps}."
            )

    @property
    def is_aligned(self) -> bool:
        """Whether a chunk's actions are executed at the steps that they are meant for."""
        return self.delay_alignment == "skip" and not self.execution.waits

    @property
    def min_chunk_size(self) -> int:
        """The shortest chunk that leaves no step without an action while every delay is the shortest."""
        return self._rows(shortest_steps(self.delay))

    @property
    def planned_rows(self) -> int:
        """How many actions a scripted policy plans: enough for the longest delay that is known."""
        longest = longest_steps(self.delay)
        return self._rows(self.n_action_steps if longest is None else longest)

    @property
    def interval_steps(self) -> int | None:
        """How many steps lie between two inferences; None if delays that vary can change it."""
        longest = longest_steps(self.delay)
        return None if longest is None or isinstance(self.delay, VaryingDelay) else self._interval(longest)

    def _interval(self, delay_steps: int) -> int:
        waiting = delay_steps if self.execution.waits else 0
        return max(self.n_action_steps + waiting, delay_steps)

    def _rows(self, delay_steps: int) -> int:
        if self.execution.waits:
            return self.n_action_steps
        return max(self.n_action_steps, delay_steps) + (delay_steps if self.is_aligned else 0)

    def check_chunk_size(self, chunk_size: int, *, policy: str) -> None:
        """Raise `SpecMismatchError` if chunks of this length are too short."""
        if chunk_size < self.min_chunk_size:
            raise SpecMismatchError(
                f"policy '{policy}' predicts chunks of {chunk_size} actions, but n_action_steps="
                f"{self.n_action_steps} with a delay of {shortest_steps(self.delay)} steps "
                f"({self.mode}, {self.delay_alignment}) needs {self.min_chunk_size}. Lower n_action_steps or "
                "the delay, or use a policy of longer chunks."
            )


class Executed(NamedTuple):
    """What a chunk, or several, say about one step."""

    action: FloatArray  # (A,)
    inferred_at_step: int  # of the newest chunk that it is from


class _Arrived(NamedTuple):
    inferred_at_step: int
    first_step: int  # the step that actions[0] is executed at
    usable_from: int
    actions: FloatArray


class ChunkExecutor:
    """Executes the chunks of one episode."""

    def __init__(self, spec: ChunkingSpec, delays: EpisodeDelays) -> None:
        self.spec = spec
        self.delays = delays
        self.next_inference_step = spec.first_inference_step
        """The step whose observation is to be given to the policy next."""
        self._chunks: list[_Arrived] = []

    def submit(self, step: int, chunk: ActionChunk, *, seconds: float) -> None:
        """Take the chunk that was inferred from the observation at `step` in so many seconds."""
        spec = self.spec
        delay_steps = self.delays.note(seconds)
        arrival = step + delay_steps
        first_step = step if spec.is_aligned else arrival
        self._chunks.append(_Arrived(step, first_step, arrival, chunk.actions.copy()))
        self.next_inference_step = step + spec._interval(delay_steps)

    def committed(self, step: int, *, n_dims: int) -> CommittedActions | None:
        """Return what is left of the chunk under way for a policy that infers at `step`; None if not told."""
        if not self.spec.execution.commits:
            return None
        arrived = [c for c in self._chunks if c.usable_from <= step < c.first_step + len(c.actions)]
        if not arrived:
            return CommittedActions(actions=np.zeros((0, n_dims), dtype=np.float32), n_frozen=0)
        actions = arrived[-1].actions[step - arrived[-1].first_step :].copy()
        return CommittedActions(actions=actions, n_frozen=min(self.delays.expected_steps, len(actions)))

    def action(self, step: int) -> Executed | None:
        """Return what to execute at `step`; None where the arm holds still."""
        usable = self._usable(step)
        if not usable:
            return None
        newest = usable[-1]
        if not self.spec.execution.averages:
            return Executed(newest.actions[step - newest.first_step].copy(), newest.inferred_at_step)
        weights = np.array([math.exp(-self.spec.ensemble_decay * i) for i in range(len(usable))])
        proposed = np.stack([c.actions[step - c.first_step] for c in usable]).astype(np.float64)
        mean: FloatArray = (weights @ proposed / weights.sum()).astype(np.float32)
        return Executed(mean, newest.inferred_at_step)

    def _usable(self, step: int) -> list[_Arrived]:
        """Return the chunks that say something about `step`, oldest first; forget those that are used up."""
        self._chunks = [c for c in self._chunks if step < c.first_step + len(c.actions)]
        if self.spec.execution.waits and any(step < c.usable_from for c in self._chunks):
            return []  # thinking
        return [c for c in self._chunks if c.usable_from <= step]
