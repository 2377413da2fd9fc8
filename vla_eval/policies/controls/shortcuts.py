"""Controls that succeed without a memory of their own; docs/audit.md says what each does."""

from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import ActionChunk, ObservationWindow
from vla_eval.errors import SpecMismatchError
from vla_eval.oracles import carry
from vla_eval.oracles.arm_model import GRIPPER_MAX_WIDTH_M
from vla_eval.oracles.cradle import IMAGINED_VELOCITY_X_M_S, ROLLING_SHARE
from vla_eval.oracles.hover import CUBES, MUGS
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.base import (
    ScriptedPolicy,
    check_has,
    hold_rows,
    in_any_control_mode,
    task_expert,
)
from vla_eval.policies.controls.candidate_controls import CandidateExpert
from vla_eval.policies.controls.scripted import BallExpertFactory
from vla_eval.task_state import BodyState, PrivilegedState
from vla_eval.tasks.catalog import task_spec


class BodyMemoryPolicy(ScriptedPolicy):
    """Keeps the cue in the width of its gripper; see the module's text."""

    privileged = True

    def __init__(self, context: PolicyContext, expert: CandidateExpert) -> None:
        super().__init__(context)
        self._expert = expert
        # The first candidate is the open gripper, as it is when an episode begins.
        self._widths_m = GRIPPER_MAX_WIDTH_M * (1 - np.arange(context.n_candidates) / context.n_candidates)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Write the cue into the gripper, hold it, or read it and go."""
        state = self.privileged_state(window)
        if state.phase == "cue":
            candidate = state.target
            if candidate is None:
                raise SpecMismatchError(
                    f"policy '{self.spec.name}' keeps one candidate in its gripper; {self._context.env.task} "
                    f"has several right ones. Leave this task out for this policy."
                )
        else:
            candidate = int(np.abs(self._widths_m - state.gripper_width_m).argmin())
        rows = hold_rows(float(self._widths_m[candidate]), self._n_actions, self._n_dims)
        if state.phase == "response":
            rows[:, :-1] = self._expert.plan(state, candidate, self._n_actions)[:, :-1]
        return ActionChunk(actions=rows)


@in_any_control_mode
def make_body_memory(context: PolicyContext) -> ScriptedPolicy:
    """Make the `body_memory` control; refuse a task without candidates or with several to touch."""
    expert = task_expert(context)
    one_is_right = context.n_candidates > 0 and not task_spec(context.env.task).several_right
    does = "keeps in its gripper which one of several candidates is right"
    check_has(one_is_right, context, does, "has no such choice")
    return BodyMemoryPolicy(context, cast(CandidateExpert, expert))


CUE_PLACE_M = (0.0, 0.0, 0.02)
"""Where cubes and other items are shown: the middle of the table, world frame (docs/tasks.md)."""


class CueTouchPolicy(ScriptedPolicy):
    """Goes to the place of the cue and stays there; see the module's text."""

    privileged = True

    def __init__(self, context: PolicyContext) -> None:
        """Look up whether the cue is shown where the right candidate will be."""
        super().__init__(context)
        self._marks_place = task_spec(context.env.task).cue_marks_place

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Continue to the place of the cue, or rest there."""
        state = self.privileged_state(window)
        if not self._marks_place:
            there = replace(state, candidate_positions_m=np.array([CUE_PLACE_M]))
            return ActionChunk(actions=CUBES.plan(there, 0, self._n_actions))
        if state.phase == "delay":
            return ActionChunk(actions=hold_rows(state.gripper_width_m, self._n_actions, self._n_dims))
        candidate = state.target if state.phase == "cue" else _nearest(state)
        assert candidate is not None  # one place is shown in these tasks
        return ActionChunk(actions=MUGS.plan(state, candidate, self._n_actions))


def _nearest(state: PrivilegedState) -> int:
    """Return the candidate nearest to the gripper, seen from above."""
    offsets = state.candidate_positions_m - state.tcp_position_m
    return int(np.linalg.norm(offsets[:, :2], axis=1).argmin())


@in_any_control_mode
def make_cue_touch(context: PolicyContext) -> ScriptedPolicy:
    """Make the `cue_touch` control; refuse a task without candidates, where none is shown."""
    lacks = "shows none at a place of its own"
    check_has(context.n_candidates > 0, context, "goes to where the cue is shown", lacks)
    return CueTouchPolicy(context)


BESIDE_M = 0.09
"""The arm is next to the ball, seen from above: an arm that waits next to the lane is nearer than this only
while the ball passes."""


class OneFrameOfBallPolicy(ScriptedPolicy):
    """Sees where the ball is, not how it moves; see the module's text."""

    privileged = True

    def __init__(
        self, context: PolicyContext, make_expert: BallExpertFactory, velocity_range_m_s: tuple[float, float]
    ) -> None:
        super().__init__(context)
        self._make_expert = make_expert
        self._rolling_m_s = ROLLING_SHARE * np.array(velocity_range_m_s)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Plan a chunk with an expert that has seen nothing before this frame."""
        state = self.privileged_state(window)
        ball = replace(state.bodies["ball"], velocity_m_s=self._supposed_velocity_m_s(state))
        bodies: dict[str, BodyState] = {**state.bodies, "ball": ball}
        expert = self._make_expert(rng=self._rng[window.slot], imagined=False)
        rows = expert.plan(replace(state, bodies=bodies), window.last.step, self._n_actions)
        return ActionChunk(actions=rows)

    def _supposed_velocity_m_s(self, state: PrivilegedState) -> NDArray[np.float64]:
        least, most = self._rolling_m_s
        own_y = state.tcp_velocity_m_s[1]
        away_m = np.linalg.norm((state.bodies["ball"].position_m - state.tcp_position_m)[:2])
        follows = away_m < BESIDE_M and own_y > least / 2
        along_y = np.clip(own_y, least, most) if follows else (least + most) / 2
        return np.array([ROLLING_SHARE * np.mean(IMAGINED_VELOCITY_X_M_S), along_y, 0.0])


class OneFrameOfCubePolicy(ScriptedPolicy):
    """Sees where cube and disc are, and the disc's colour; see the module's text."""

    privileged = True

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Plan a chunk."""
        return ActionChunk(actions=carry.plan_from_one_frame(self.privileged_state(window), self._n_actions))


@in_any_control_mode
def make_one_frame(context: PolicyContext) -> ScriptedPolicy:
    """Make the `one_frame` control; refuse a task without a rolling ball that is not TakeItBack."""
    task = task_spec(context.env.task)
    does = "is for tasks in which a ball rolls and for TakeItBack-v0"
    check_has(task.seen_in_one_frame is not None, context, does, "is neither")
    if task.seen_in_one_frame == "ball":
        expert = cast(BallExpertFactory, task_expert(context))
        return OneFrameOfBallPolicy(context, expert, task.kwargs["velocity_range_m_s"])
    return OneFrameOfCubePolicy(context)
