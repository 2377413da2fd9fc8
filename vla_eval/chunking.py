"""Turn chunks of actions into one action per control step. Knows nothing of policies or simulators.

Time is counted in control steps since reset. A chunk inferred from the observation at step `s` holds
actions for steps `s, s + 1, …`; with a delay of `d` steps it is available from step `s + d` on.

- `receding_horizon`: the first `n_action_steps` actions are executed, then a new inference replaces
  the rest. With `n_action_steps` equal to the chunk's length this is open-loop execution.
- `temporal_ensemble`: an inference every `n_action_steps` steps; the action of a step is the weighted
  mean of what all chunks say about that step, weight `exp(-decay * i)` for the i-th oldest chunk.
  Source: Zhao et al. 2023 (ACT, arXiv:2304.13705), section IV-B, where decay is called m.

The first inference is at step `first_inference_step`, and the arm holds still until its chunk arrives.

With a delay, what a chunk says about steps that are past when it arrives is dropped (`delay_alignment:
skip`), as a robot that keeps moving during inference must do; or the whole chunk is executed late
(`stale`), which is what a loop that does not know of its own latency does.
"""

import math
from dataclasses import dataclass, fields
from typing import Annotated, Literal, NamedTuple

import numpy as np

from vla_eval.core import ActionChunk, FloatArray
from vla_eval.errors import RecipeError, SpecMismatchError
from vla_eval.strict.bounds import MAX_STEPS, Bounds, Steps, check_bounds


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkingSettings:
    """How chunks are executed, at any n_action_steps: the section `chunking` of an evaluation."""

    mode: Literal["receding_horizon", "temporal_ensemble"] = "receding_horizon"
    delay_steps: Annotated[int, Bounds(0, MAX_STEPS)] = 0
    delay_alignment: Literal["skip", "stale"] = "skip"
    ensemble_decay: Annotated[float, Bounds(0)] = 0.01  # the value of ACT's public code
    first_inference_step: Annotated[int, Bounds(0)] = 0

    def __post_init__(self) -> None:
        check_bounds(self, prefix="chunking.")

    def at(self, n_action_steps: int) -> "ChunkingSpec":
        """Return the chunking at a number of action steps."""
        settings = {field.name: getattr(self, field.name) for field in fields(ChunkingSettings)}
        return ChunkingSpec(n_action_steps=n_action_steps, **settings)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkingSpec(ChunkingSettings):
    """How chunks are executed at one n_action_steps: what a policy and a rollout get.

    Raises:
        RecipeError: a value out of its range.
    """

    n_action_steps: Steps

    def __post_init__(self) -> None:
        check_bounds(self, prefix="chunking.")
        if self.first_inference_step >= self.n_action_steps:
            raise RecipeError(
                f"chunking.first_inference_step is {self.first_inference_step}, expected less than "
                f"n_action_steps, which is {self.n_action_steps}."
            )

    @property
    def n_skipped(self) -> int:
        """How many actions of each chunk are over before it arrives."""
        return self.delay_steps if self.delay_alignment == "skip" else 0

    @property
    def min_chunk_size(self) -> int:
        """The shortest chunk that leaves no step without an action."""
        return self.n_action_steps + self.n_skipped

    def check_chunk_size(self, chunk_size: int, *, policy: str) -> None:
        """Raise `SpecMismatchError` if chunks of this length are too short."""
        if chunk_size < self.min_chunk_size:
            raise SpecMismatchError(
                f"policy '{policy}' predicts chunks of {chunk_size} actions, but n_action_steps="
                f"{self.n_action_steps} with delay_steps={self.delay_steps} ({self.delay_alignment}) needs "
                f"{self.min_chunk_size}. Lower n_action_steps or the delay, or use a policy of longer chunks."
            )


class _Arrived(NamedTuple):
    first_step: int  # the step that actions[0] is executed at
    usable_from: int
    actions: FloatArray


class ChunkExecutor:
    """Executes the chunks of one episode."""

    def __init__(self, spec: ChunkingSpec) -> None:
        self.spec = spec
        self.next_inference_step = spec.first_inference_step
        """The step whose observation is to be given to the policy next."""
        self._chunks: list[_Arrived] = []

    def submit(self, step: int, chunk: ActionChunk) -> None:
        """Take the chunk that was inferred from the observation at `step`."""
        spec = self.spec
        arrival = step + spec.delay_steps
        self._chunks.append(_Arrived(arrival - spec.n_skipped, arrival, chunk.actions.copy()))
        self.next_inference_step = step + spec.n_action_steps

    def action(self, step: int) -> FloatArray | None:
        """Return the (A,) action to execute at `step`, or None while no chunk has arrived yet."""
        self._chunks = [c for c in self._chunks if step < c.first_step + len(c.actions)]
        usable = [c for c in self._chunks if c.usable_from <= step]
        if not usable:
            return None
        if self.spec.mode == "receding_horizon":
            newest = usable[-1]
            chosen: FloatArray = newest.actions[step - newest.first_step].copy()
            return chosen
        weights = np.array([math.exp(-self.spec.ensemble_decay * i) for i in range(len(usable))])
        proposed = np.stack([c.actions[step - c.first_step] for c in usable]).astype(np.float64)
        mean: FloatArray = (weights @ proposed / weights.sum()).astype(np.float32)
        return mean
