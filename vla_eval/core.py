"""The contracts of one evaluated episode: observations in, chunks of actions out, a result per step.

Read this file, then `rollout.py`, and you can follow an episode from reset to record. Everything
here is numpy and the standard library: it knows nothing of simulators, models or files. A task's
status and true state have a file of their own, `task_state.py`.

A *slot* is one of the episodes that run side by side in one environment object; every per-episode
value is keyed by it. An episode is a function of (task, seed, actions) alone, whatever its slot.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable  # Any: arrays of any dtype

import numpy as np
from numpy.typing import NDArray

from vla_eval.specs import EnvSpec, PolicySpec
from vla_eval.task_state import HiddenState, PrivilegedState, TaskStatus

Stage = Literal["setup", "reset", "step", "inference"]
"""What a worker is busy with; each stage has a time limit of its own."""

FloatArray = NDArray[np.float32]
ImageArray = NDArray[np.uint8]
MemoryArrays = Mapping[str, NDArray[Any]]
"""What a policy keeps of an episode, by name; which names, dtypes and shapes is up to the policy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """What can be observed after `step` control steps."""

    step: int  # control steps executed since reset; 0 is the reset observation
    # camera name -> (H, W, 3) uint8 RGB. Empty if no image was requested: a camera is never replaced by a
    # blank one.
    images: Mapping[str, ImageArray]
    state: Mapping[str, FloatArray]  # name -> (D,) float32, as `EnvSpec.states` describes them
    # the true state of the world; None unless the policy declares that it is privileged
    privileged: PrivilegedState | HiddenState | None = None

    def as_declared(self, spec: PolicySpec) -> "Observation":
        """Return what a policy has declared that it reads: observers may have asked for more.

        A missing image stays missing: `check_compatible` has found each camera in the environment.
        """
        images = {name: image for name, image in self.images.items() if name in spec.cameras}
        return replace(self, images=images, privileged=self.privileged if spec.privileged else None)


@dataclass(frozen=True, slots=True, kw_only=True)
class CommittedActions:
    """What is left of the chunk under way when a policy infers: the new chunk has to join it."""

    actions: FloatArray  # (N, A) float32; row i is meant for step `window.last.step + i`; N may be 0
    # the first so many are expected to be executed before the new chunk can arrive; it may change the others
    n_frozen: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationWindow:
    """The observations since the previous inference of one episode, oldest first, never empty.

    A policy that reads only the last frame gets just that one.
    """

    slot: int
    frames: tuple[Observation, ...]
    committed: CommittedActions | None = None  # None unless the policy reads it and the mode tells it

    @property
    def last(self) -> Observation:
        """The newest observation."""
        return self.frames[-1]


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionChunk:
    """Actions for the control steps from the observed one on."""

    actions: FloatArray  # (T, A) float32; row i is meant for step `window.last.step + i`


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeStart:
    """What a policy gets when an episode begins."""

    slot: int  # the slot the episode runs in
    task: str  # task id, for example `RememberColor3-v0`
    seed: int  # the episode's seed; the environment is reset with it
    run: int  # which of several independent runs (training seeds) this is, from 0
    instruction: str  # empty for a task without one
    horizon_steps: int  # the episode ends after so many control steps
    # the episode's row in a forward pass that it shares with others. Batched results are bit-identical only
    # at a fixed row and batch size, so the plan fixes the row.
    row: int = 0

    def worded(self, wording: Mapping[str, str]) -> "EpisodeStart":
        """Return it with values in place of the words in braces of the instruction."""
        instruction = self.instruction
        for word, value in wording.items():
            instruction = instruction.replace(f"{{{word}}}", value)
        return replace(self, instruction=instruction)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepResult:
    """What comes back from a reset or a control step of one slot."""

    observation: Observation  # what can be observed now
    status: TaskStatus  # what the task says of the episode so far
    reward: float = 0.0  # of the step; 0 for a reset
    # (A,) the action as it was carried out: clipped to the action space, and replaced by holding still while
    # the task freezes the arm. None for a reset.
    executed_action: FloatArray | None = None
    # of a reset: what to put in place of the words in braces of the instruction, where it differs per episode
    wording: Mapping[str, str] = field(default_factory=dict)


class SimEnv(Protocol):
    """Some episodes of one task, side by side. Seeds have no default."""

    @property
    def spec(self) -> EnvSpec:
        """Cameras, states, action and horizon, as they are for every slot."""

    def reset(self, seeds: Mapping[int, int], *, render: bool) -> dict[int, StepResult]:
        """Begin an episode in each of the slots (slot -> seed); `render`: with images in its observation."""

    def step(self, actions: Mapping[int, FloatArray], *, render: frozenset[int]) -> dict[int, StepResult]:
        """Execute one control step in each of the slots (slot -> (A,) float32).

        `render`: the slots whose new observation must hold images.
        """

    def hold_action(self, slot: int) -> FloatArray:
        """Return the (A,) action that leaves arm and gripper as they are now."""

    def close(self) -> None:
        """Release the simulator."""


class Policy(Protocol):
    """Observations in, chunks of actions out; a `BatchPolicy` infers for several slots at once."""

    @property
    def spec(self) -> PolicySpec:
        """What the policy reads and how long its chunks are."""

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin these episodes: forget all else about their slots.

        A probe also calls it in mid-episode (`RolloutSettings.reset_policy_at_step`), with the same start.
        """

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Decide on the actions from the last observation of the window on."""


@runtime_checkable
class BatchPolicy(Policy, Protocol):
    """A policy that infers for several slots at once: the loop calls `act_batch` instead of `act`.

    A chunk must not depend on the other slots. A call that raises leaves every slot as it was, so that each
    can be asked again alone.
    """

    def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        """Decide for each window; the order of the answers is that of the windows."""


def infer(policy: Policy, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
    """Return the chunks of a policy for some windows, in one call if it can."""
    if isinstance(policy, BatchPolicy):
        return policy.act_batch(windows)
    return [policy.act(window) for window in windows]


@runtime_checkable
class ForgettingPolicy(Policy, Protocol):
    """A policy that can release the memory of an episode that is over, before the next `reset`."""

    def forget(self, slots: Sequence[int]) -> None:
        """Release the memory of these slots: their next call is `reset`."""


@runtime_checkable
class RememberingPolicy(Policy, Protocol):
    """A policy whose memory can be read and replaced, if `PolicySpec.has_memory` says so.

    A memory is complete: an episode whose next inferences follow a `set_memory` is bit-equal to the one that
    it was taken from. What is drawn at an inference and what is still to be executed are not part of it.
    """

    def get_memory(self, slot: int) -> MemoryArrays:
        """Return what is kept after the slot's last inference; before the first: what an episode begins with.

        Raises:
            SpecMismatchError: what the policy keeps cannot be read.
        """

    def set_memory(self, slot: int, memory: MemoryArrays) -> None:
        """Put a memory in place of the slot's; it keeps no reference to the arrays.

        Raises:
            SpecMismatchError: the arrays are not those of such a policy; nothing is changed.
        """


class StepObserver(Protocol):
    """Watches episodes without touching them: videos, datasets, viewers, heartbeats."""

    def wants_images(self, step: int) -> bool:
        """Whether the observation after `step` control steps must hold images for this observer."""
        return False

    def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
        """Called once per episode with the reset observation."""
        return

    def on_inference(self, episode: EpisodeStart, step: int, chunk: ActionChunk) -> None:
        """Called with each chunk that the policy returned for the observation at `step`."""
        return

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        """Called after each control step with the action asked for; `result` has the executed one."""
