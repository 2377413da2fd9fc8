"""Expert for InterceptGrab: fly over the ball at its own speed, descend around it, close, stop.

The fingers are aligned along y, and the ball rolls along y. A hand at rest would block it. A hand that
moves with the ball does not: one finger is in front of the ball and one behind.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vla_eval.oracles import arm_model as model
from vla_eval.oracles.cradle import (
    IMAGINED_VELOCITY_X_M_S,
    IMAGINED_Y_M,
    ROLLING_SHARE,
    UNSEEN_STEPS,
    lane_x_m,
)
from vla_eval.task_state import PrivilegedState

HOVER_M = 0.075  # of the tool centre point over the table: fingertips above the ball's top
GRASP_M = 0.02
CLOSE_BELOW_M = 0.032
ALIGNED_M = 0.010
TRACK_GAIN_PER_S = 6.0
START_LEAD_S = 0.06
BALL_DIAMETER_M = 0.04
HELD_WIDTH_M = 0.043
LANE_X_M = (-0.35, -0.05)
BASE_X_M = -0.615
MIN_REACH_M = 0.32  # closer to the base the inverse kinematics finds no pose at the ball's height


@dataclass(frozen=True, slots=True, kw_only=True)
class _Play:
    """State of the model: arm, ball in the plane of the table, and the controller's internal state."""

    arm: model.ArmState
    ball_m: model.Vector
    ball_velocity_m_s: model.Vector
    meet_y_m: float
    stage: str


class CatchExpert:
    """One episode's expert; with an imagined ball it catches that one."""

    def __init__(
        self,
        *,
        meet_y_m: float,
        nominal_speed_m_s: float,
        imagined_ball: tuple[model.Vector, model.Vector] | None,
    ) -> None:
        self._meet_y_m = meet_y_m
        self._nominal_speed_m_s = nominal_speed_m_s
        self._imagined_ball = imagined_ball
        self._stage = "wait"

    def plan(self, state: PrivilegedState, step: int, n_actions: int) -> NDArray[np.float32]:
        """Return (n_actions, 7), planned from this state alone (and, blind, from the imagined ball)."""
        ball_m, velocity_m_s = self._ball(state, step)
        play = _Play(
            arm=model.arm_state(state),
            ball_m=ball_m,
            ball_velocity_m_s=velocity_m_s,
            meet_y_m=self._meet_y_m,
            stage=self._stage,
        )
        rows = []
        for index in range(n_actions):
            play = _decide(play)
            if index == 0:
                self._stage = play.stage
            translation = _command(play)
            gripper = model.GRIPPER_CLOSED if play.stage in ("close", "stop") else model.GRIPPER_OPEN
            rows.append(model.action_row(translation, gripper))
            play = _advance(play, translation, gripper)
        if self._imagined_ball is not None:
            self._imagined_ball, self._stage = (play.ball_m, play.ball_velocity_m_s), play.stage
        return np.stack(rows)

    def _ball(self, state: PrivilegedState, step: int) -> tuple[model.Vector, model.Vector]:
        if self._imagined_ball is not None:
            return self._imagined_ball
        if step < UNSEEN_STEPS:
            velocity = np.array([0.0, self._nominal_speed_m_s])
            start = np.array([np.mean(LANE_X_M), np.mean(IMAGINED_Y_M)])
            return start + velocity * step * model.STEP_SECONDS, velocity
        body = state.bodies["ball"]
        return body.position_m[:2], body.velocity_m_s[:2]


def _decide(play: _Play) -> _Play:
    arm, stage = play.arm, play.stage
    offset = play.ball_m - arm.position_m[:2]
    if stage == "wait" and offset[1] > -START_LEAD_S * play.ball_velocity_m_s[1]:
        stage = "chase"
    if stage == "chase" and np.abs(offset).max() < ALIGNED_M:
        stage = "descend"
    if stage == "descend" and arm.position_m[2] < CLOSE_BELOW_M:
        stage = "close"
    if stage == "close" and arm.width_m < HELD_WIDTH_M:
        stage = "stop"
    return replace(play, stage=stage)


def _command(play: _Play) -> model.Vector:
    arm = play.arm
    if play.stage == "wait":
        return model.towards(np.array([*_waiting_place_m(play), HOVER_M]), arm)
    height = HOVER_M if play.stage == "chase" else GRASP_M
    rise = float(np.clip(model.POSITION_GAIN_PER_M * (height - arm.position_m[2]), -1, 1))
    if play.stage == "stop":
        return np.array([0.0, 0.0, rise])
    velocity = play.ball_velocity_m_s + TRACK_GAIN_PER_S * (play.ball_m - arm.position_m[:2])
    return np.clip(np.array([*(velocity / model.FULL_SPEED_M_S), rise]), -1, 1)


def _waiting_place_m(play: _Play) -> model.Vector:
    """Return (x, y) over the ball's lane where the arm waits for it."""
    y = play.meet_y_m
    x = lane_x_m(play.ball_m, play.ball_velocity_m_s, y)
    from_base_x = x - BASE_X_M
    if np.hypot(from_base_x, y) < MIN_REACH_M:
        y = -float(np.sqrt(max(MIN_REACH_M**2 - from_base_x**2, 0.0)))
    return np.array([x, y])


def _advance(play: _Play, translation: model.Vector, gripper: float) -> _Play:
    """Return the model's state one control step later: the ball rolls, or moves with the hand."""
    arm = model.advance_gripper(
        model.advance(play.arm, translation), 0.0, gripper, held_width_m=BALL_DIAMETER_M
    )
    velocity = arm.step_m[:2] / model.STEP_SECONDS if play.stage == "stop" else play.ball_velocity_m_s
    return replace(
        play, arm=arm, ball_m=play.ball_m + velocity * model.STEP_SECONDS, ball_velocity_m_s=velocity
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Catches:
    """Makes the expert of an episode."""

    velocity_range_m_s: tuple[float, float]  # of the ball's initial speed
    meet_y_m: float  # where over the lane the arm waits for the ball

    def __call__(self, *, rng: np.random.Generator, imagined: bool) -> CatchExpert:
        """Draw the imagined ball now, before the first observation."""
        start = np.array([rng.uniform(*LANE_X_M), rng.uniform(*IMAGINED_Y_M)])
        speed = np.array([rng.uniform(*IMAGINED_VELOCITY_X_M_S), rng.uniform(*self.velocity_range_m_s)])
        return CatchExpert(
            meet_y_m=self.meet_y_m,
            nominal_speed_m_s=ROLLING_SHARE * float(np.mean(self.velocity_range_m_s)),
            imagined_ball=(start, speed * ROLLING_SHARE) if imagined else None,
        )


SLOW = Catches(velocity_range_m_s=(0.25, 0.5), meet_y_m=-0.35)
MEDIUM = Catches(velocity_range_m_s=(0.5, 0.75), meet_y_m=-0.3)
FAST = Catches(velocity_range_m_s=(0.75, 1.0), meet_y_m=-0.15)
