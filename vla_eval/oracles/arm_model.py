"""A model of the arm's response to `pd_ee_delta_pose`, good enough to plan some steps open loop.

The controller's target is the *present* pose plus the action, followed by a damped spring, so that a
constant action leads to a constant speed. Measured with mani_skill 3.0.1 on a Panda: a constant action
of 1 moves the tool centre point by 16, 32, 37, 39, 39 … mm per control step.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_eval.task_state import PrivilegedState

Vector = NDArray[np.float64]

FULL_SPEED_M_PER_STEP = 0.039
RESPONSE = 0.7  # share of the gap to the commanded speed closed in one control step (fit to the above)
STEP_SECONDS = 0.05
FULL_SPEED_M_S = FULL_SPEED_M_PER_STEP / STEP_SECONDS
FULL_TURN_RAD_PER_STEP = 0.039
POSITION_GAIN_PER_M = 13.0  # action per metre of distance: half the distance per step
TURN_GAIN_PER_RAD = 13.0
GRIPPER_OPEN = 1.0
GRIPPER_CLOSED = -1.0
FINGER_LOW_M, FINGER_HIGH_M = -0.01, 0.04  # finger positions at commands -1 and 1
GRIPPER_MAX_WIDTH_M = 0.08
FINGER_RESPONSE = 0.5  # share of the distance to the commanded width in one control step
GRIPPER_CRADLE = 0.0  # leaves a gap of 3 cm between the fingers
N_ACTION_DIMS = 7


class ArmState(NamedTuple):
    """Tool centre point: position (m) and displacement per control step (m), (3,) each, world frame.

    Also its yaw (rad) and turn per control step (rad) about world z, and the gap between the fingers (m).
    """

    position_m: Vector
    step_m: Vector
    yaw_rad: float
    turn_rad: float
    width_m: float


def arm_state(state: PrivilegedState) -> ArmState:
    """Return the model's state; how fast the wrist turns is not measured."""
    step_m = state.tcp_velocity_m_s * STEP_SECONDS
    return ArmState(state.tcp_position_m.copy(), step_m, state.tcp_yaw_rad, 0.0, state.gripper_width_m)


def advance(arm: ArmState, translation: Vector) -> ArmState:
    """Return where the arm is one control step later, given the (3,) translation part of an action."""
    step_m = arm.step_m + RESPONSE * (FULL_SPEED_M_PER_STEP * translation - arm.step_m)
    return arm._replace(position_m=arm.position_m + (arm.step_m + step_m) / 2, step_m=step_m)


def advance_gripper(arm: ArmState, turn: float, gripper: float, *, held_width_m: float) -> ArmState:
    """Return the arm one control step later; turn (counterclockwise) and gripper are in [-1, 1]."""
    turn_rad = arm.turn_rad + RESPONSE * (FULL_TURN_RAD_PER_STEP * turn - arm.turn_rad)
    wanted_m = 2 * (FINGER_LOW_M + (gripper + 1) / 2 * (FINGER_HIGH_M - FINGER_LOW_M))
    width_m = arm.width_m + FINGER_RESPONSE * (wanted_m - arm.width_m)
    return arm._replace(
        yaw_rad=arm.yaw_rad + (arm.turn_rad + turn_rad) / 2,
        turn_rad=turn_rad,
        width_m=min(max(width_m, held_width_m), GRIPPER_MAX_WIDTH_M),
    )


def towards(goal_m: Vector, arm: ArmState) -> Vector:
    """Return the (3,) translation that moves the arm to a point: half the distance per step, at most 1."""
    return np.clip(POSITION_GAIN_PER_M * (goal_m - arm.position_m), -1, 1)


def follow(
    goal_of: Callable[[ArmState], Vector], state: PrivilegedState, n_actions: int, *, gripper: float
) -> NDArray[np.float32]:
    """Return (n_actions, 7) that move the arm to the point that is its goal at each step of the model."""
    arm = arm_state(state)
    rows = []
    for _ in range(n_actions):
        translation = towards(goal_of(arm), arm)
        rows.append(action_row(translation, gripper))
        arm = advance(arm, translation)
    return np.stack(rows)


def turn_towards(yaw_rad: float, arm: ArmState) -> float:
    """Return the turn in [-1, 1] that brings the wrist to a yaw; the caller chooses the direction."""
    return float(np.clip(TURN_GAIN_PER_RAD * (yaw_rad - arm.yaw_rad), -1, 1))


def wrapped_rad(angle_rad: float, period_rad: float = 2 * np.pi) -> float:
    """Return the same angle in [-period/2, period/2)."""
    return float((angle_rad + period_rad / 2) % period_rad - period_rad / 2)


def gripper_command(finger_m: float) -> float:
    """Return the gripper command that holds the fingers at this position each."""
    return float(np.clip((finger_m - FINGER_LOW_M) / (FINGER_HIGH_M - FINGER_LOW_M) * 2 - 1, -1, 1))


def action_row(translation: Vector, gripper: float, turn: float = 0.0) -> NDArray[np.float32]:
    """Return the (7,) action with this translation, turn about world z and gripper command.

    ManiSkill multiplies rotations with the lower bound, -0.1 rad, so their sign is inverted.
    """
    row = np.zeros(N_ACTION_DIMS, dtype=np.float32)
    row[:3] = np.clip(translation, -1, 1)
    row[5] = 0.0 - np.clip(turn, -1, 1)  # not -0.0 if there is no turn: digests are computed from bytes
    row[-1] = gripper
    return row
