"""Controls: policies without a model, against which a learned one is measured.

- `random`: uniform in the action space. Says how often one succeeds by flailing, which is hardly ever.
- `hold`: moves nothing, keeps the gripper's width.
- `oracle`: the privileged expert: the ceiling at this chunk length.
- `cue_blind`: the same arm, not knowing the cue: what a perfect arm without memory gets (chance).
- `tour`: the same arm begins with a random candidate and goes on to the nearest that is left, without
  ever knowing which one is right: what can be had by searching.

The last three see the true state of the world, but not the answer before the choice can be made, and
plan a whole chunk open loop from what they see at one inference. Nothing here is ever rendered.
"""

import importlib
import zlib
from collections.abc import Sequence
from typing import Literal, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow, PrivilegedState
from vla_eval.errors import SpecMismatchError
from vla_eval.policies.context import PolicyContext
from vla_eval.specs import PolicySpec
from vla_eval.tasks.catalog import task_spec
from vla_eval.tasks.streams import Stream, generator

# ManiSkill's Panda: the gripper command in [-1, 1] is mapped to finger positions in this range.
FINGER_LOW_M, FINGER_HIGH_M = -0.01, 0.04
STATIC_RAD_S = 0.2


class CandidateExpert(Protocol):
    """Brings the arm to one of several candidates."""

    def is_done(self, state: PrivilegedState, candidate: int) -> bool:
        """Whether all is done with this candidate that is to be done, but for coming to rest."""

    def plan(self, state: PrivilegedState, candidate: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7)."""


class BallExpert(Protocol):
    """Plays a rolling ball; one object per episode."""

    def plan(self, state: PrivilegedState, step: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7)."""


class BallExpertFactory(Protocol):
    """Makes a ball expert; with `imagined` it plays a ball drawn from `rng` instead of the real one."""

    def __call__(self, *, rng: np.random.Generator, imagined: bool) -> BallExpert:
        """Make one for a new episode."""


def hold_rows(gripper_width_m: float, n_actions: int, n_dims: int = 7) -> NDArray[np.float32]:
    """Return (n_actions, n_dims) that move nothing and keep the fingers `gripper_width_m` apart."""
    rows = np.zeros((n_actions, n_dims), dtype=np.float32)
    finger_m = gripper_width_m / 2
    command = (finger_m - FINGER_LOW_M) / (FINGER_HIGH_M - FINGER_LOW_M) * 2 - 1
    rows[:, -1] = np.clip(command, -1, 1)
    return rows


class _Scripted:
    """What all controls share: their spec, and one random generator per running episode."""

    privileged = False
    states: tuple[str, ...] = ()

    def __init__(self, context: PolicyContext) -> None:
        """Plan just as many actions as one inference has to give."""
        self._context = context
        self._n_actions = context.chunking.min_chunk_size
        self._n_dims = len(context.env.action.dims)
        self._rng: dict[int, np.random.Generator] = {}
        self.spec = PolicySpec(
            name=context.name,
            reads="last",
            cameras=(),
            states=self.states,
            chunk_size=self._n_actions,
            privileged=self.privileged,
        )

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Seed each episode's generator by its task, seed and run."""
        for episode in episodes:
            task_key = zlib.crc32(episode.task.encode())  # else luck would be the same luck in every task
            self._rng[episode.slot] = generator(episode.seed, Stream.POLICY, task_key, episode.run)

    def _privileged(self, window: ObservationWindow) -> PrivilegedState:
        state = window.last.privileged
        if state is None:
            raise SpecMismatchError(
                f"policy '{self.spec.name}' reads the true state of the world, but the observations of "
                f"{self._context.env.task} carry none. Make the environment with privileged=True."
            )
        return state


class RandomPolicy(_Scripted):
    """Uniform actions in the action space, drawn from the episode's own generator."""

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Draw a chunk."""
        spec = self._context.env.action
        drawn = self._rng[window.slot].uniform(spec.low, spec.high, (self._n_actions, self._n_dims))
        return ActionChunk(actions=drawn.astype(np.float32))


class HoldPolicy(_Scripted):
    """No motion; the gripper keeps the width it has when the chunk is planned."""

    states = ("qpos",)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Hold for a chunk."""
        width_m = float(window.last.state["qpos"][-2:].sum())
        return ActionChunk(actions=hold_rows(width_m, self._n_actions, self._n_dims))


class ChoicePolicy(_Scripted):
    """Goes to candidates: the right one, one drawn uniformly, or one after another."""

    privileged = True
    states = ("qvel",)

    def __init__(
        self, context: PolicyContext, expert: CandidateExpert, mode: Literal["oracle", "cue_blind", "tour"]
    ) -> None:
        """Take the expert of the task's family."""
        super().__init__(context)
        self._expert = expert
        self._mode = mode
        self._order: dict[int, list[int]] = {}

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Decide, without looking, where a blind arm goes (first)."""
        super().reset(episodes)
        for episode in episodes:
            order = self._rng[episode.slot].permutation(self._context.n_candidates)
            self._order[episode.slot] = [int(i) for i in order]

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Hold until the choice can be made, then go."""
        state = self._privileged(window)
        if state.phase != "response":
            return ActionChunk(actions=hold_rows(state.gripper_width_m, self._n_actions, self._n_dims))
        candidate = self._candidate(window, state)
        return ActionChunk(actions=self._expert.plan(state, candidate, self._n_actions))

    def _candidate(self, window: ObservationWindow, state: PrivilegedState) -> int:
        if self._mode == "oracle":
            assert state.target is not None  # the policy is only made for tasks with candidates
            return state.target
        order = self._order[window.slot]
        if self._mode == "tour" and len(order) > 1 and self._touches(window, state, order[0]):
            here = state.candidate_positions_m[order.pop(0)]
            order.sort(key=lambda i: float(np.linalg.norm(state.candidate_positions_m[i] - here)))
        return order[0]

    def _touches(self, window: ObservationWindow, state: PrivilegedState, candidate: int) -> bool:
        at_rest = bool(np.abs(window.last.state["qvel"][:-2]).max() <= STATIC_RAD_S)
        return at_rest and self._expert.is_done(state, candidate)


class BallPolicy(_Scripted):
    """Plays the ball with the expert; blind, it plays a ball that it imagines."""

    privileged = True

    def __init__(self, context: PolicyContext, make_expert: BallExpertFactory, *, imagined: bool) -> None:
        """Take the expert of the task's family."""
        super().__init__(context)
        self._make_expert = make_expert
        self._imagined = imagined
        self._experts: dict[int, BallExpert] = {}

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Begin with a new expert in each slot."""
        super().reset(episodes)
        for episode in episodes:
            self._experts[episode.slot] = self._make_expert(
                rng=self._rng[episode.slot], imagined=self._imagined
            )

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Plan a chunk."""
        expert = self._experts[window.slot]
        return ActionChunk(actions=expert.plan(self._privileged(window), window.last.step, self._n_actions))


def make_random(context: PolicyContext) -> RandomPolicy:
    """Make the `random` control."""
    return RandomPolicy(context)


def make_hold(context: PolicyContext) -> HoldPolicy:
    """Make the `hold` control."""
    return HoldPolicy(context)


def make_oracle(context: PolicyContext) -> ChoicePolicy | BallPolicy:
    """Make the `oracle` for the task of the context."""
    return _make_expert_policy(context, "oracle")


def make_cue_blind(context: PolicyContext) -> ChoicePolicy | BallPolicy:
    """Make the `cue_blind` control for the task of the context."""
    return _make_expert_policy(context, "cue_blind")


def make_tour(context: PolicyContext) -> ChoicePolicy | BallPolicy:
    """Make the `tour` control.

    Raises:
        SpecMismatchError: the task has no candidates to tour.
    """
    if context.n_candidates == 0:
        raise SpecMismatchError(
            f"policy '{context.name}' touches one candidate after another; {context.env.task} has none. "
            "Leave this task out for this policy."
        )
    return _make_expert_policy(context, "tour")


def _make_expert_policy(
    context: PolicyContext, mode: Literal["oracle", "cue_blind", "tour"]
) -> ChoicePolicy | BallPolicy:
    module, _, name = task_spec(context.env.task).oracle.partition(":")
    expert = getattr(importlib.import_module(module), name)
    if context.n_candidates > 0:
        return ChoicePolicy(context, cast(CandidateExpert, expert), mode)
    return BallPolicy(context, cast(BallExpertFactory, expert), imagined=mode == "cue_blind")
