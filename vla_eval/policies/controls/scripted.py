"""Controls: policies without a model (docs/measuring.md, docs/audit.md)."""

from collections.abc import Callable, Sequence
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.base import (
    ScriptedPolicy,
    TranslatedPolicy,
    check_has,
    hold_rows,
    in_any_control_mode,
    task_expert,
)
from vla_eval.policies.controls.base_players import PlayerPolicy
from vla_eval.policies.controls.candidate_controls import (
    CandidateExpert,
    ChoicePolicy,
    Mode,
    VisitExpert,
    VisitPolicy,
)
from vla_eval.task_state import PrivilegedState
from vla_eval.tasks.catalog import task_spec


class BallExpert(Protocol):
    """Meets a rolling ball; one object per episode."""

    def plan(self, state: PrivilegedState, step: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7)."""


class BallExpertFactory(Protocol):
    """Makes a ball expert; with `imagined` it meets a ball drawn from `rng` instead of the real one."""

    def __call__(self, *, rng: np.random.Generator, imagined: bool) -> BallExpert:
        """Make one for a new episode."""


class RandomPolicy(ScriptedPolicy):
    """Uniform actions in the action space, drawn from the episode's own generator."""

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Draw a chunk."""
        spec = self._context.env.action
        drawn = self._rng[window.slot].uniform(spec.low, spec.high, (self._n_actions, self._n_dims))
        return ActionChunk(actions=drawn.astype(np.float32))


class HoldPolicy(ScriptedPolicy):
    """No motion; the gripper keeps the width it has when the chunk is planned."""

    states = ("qpos",)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Hold for a chunk."""
        width_m = float(self.arm.gripper.width_m(window.last.state["qpos"]))
        return ActionChunk(actions=hold_rows(width_m, self._n_actions, self._n_dims))


class BallPolicy(ScriptedPolicy):
    """Meets the ball with the expert; the blind one meets a ball that it imagines."""

    privileged = True

    def __init__(self, context: PolicyContext, make_expert: BallExpertFactory, *, imagined: bool) -> None:
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
        state = self.privileged_state(window)
        return ActionChunk(actions=expert.plan(state, window.last.step, self._n_actions))


def make_random(context: PolicyContext) -> RandomPolicy | PlayerPolicy:
    """Make the `random` control."""
    return RandomPolicy(context) if context.env.is_instructed else PlayerPolicy(context, "random")


def make_oracle(context: PolicyContext) -> ScriptedPolicy | TranslatedPolicy | PlayerPolicy:
    """Make the `oracle` for the task of the context."""
    return _make_arm_oracle(context) if context.env.is_instructed else PlayerPolicy(context, "oracle")


def _maker(mode: Mode, does: str = "") -> Callable[[PolicyContext], ScriptedPolicy | TranslatedPolicy]:
    """Return what makes a control of the expert; one that `does` something with candidates needs some."""

    def make(context: PolicyContext) -> ScriptedPolicy:
        check_has(not does or context.n_candidates > 0, context, does, "has none")
        expert = task_expert(context)
        if context.n_candidates == 0:
            return BallPolicy(context, cast(BallExpertFactory, expert), imagined=mode == "cue_blind")
        if task_spec(context.env.task).several_right:
            return VisitPolicy(context, cast(VisitExpert, expert), mode)
        return ChoicePolicy(context, cast(CandidateExpert, expert), mode)

    return in_any_control_mode(make)


make_hold = in_any_control_mode(HoldPolicy)
_make_arm_oracle = _maker("oracle")
make_cue_blind = _maker("cue_blind")
"""Makes the `cue_blind` control for the task of the context."""
make_tour = _maker("tour", "touches one candidate after another")
"""Makes the `tour` control; raises `SpecMismatchError` if the task has no candidates to tour."""
make_cue_reader = _maker("cue_reader", "reads which candidate the cue shows")
"""Makes the `cue_reader` control; raises `SpecMismatchError` if no cue names a candidate."""
