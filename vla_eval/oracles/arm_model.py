"""How the arm answers to `pd_ee_delta_pose`: enough of a model to plan some steps open loop.

The controller's target is the *present* pose plus the action, followed by a damped spring, so that a
constant action ends in a constant speed. Measured with mani_skill 3.0.1 on a Panda: a constant action
of 1 moves the tool centre point by 16, 32, 37, 39, 39 … mm per control step.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

FULL_SPEED_M_PER_STEP = 0.039
RESPONSE = 0.7  # share of the gap to the commanded speed closed in one control step (fit to the above)
STEP_SECONDS = 0.05
FULL_SPEED_M_S = FULL_SPEED_M_PER_STEP / STEP_SECONDS
GRIPPER_OPEN = 1.0
GRIPPER_CRADLE = 0.0  # leaves a gap of 3 cm between the fingers
N_ACTION_DIMS = 7


class ArmState(NamedTuple):
    """Tool centre point: position (m) and displacement per control step (m), (3,) each, world frame."""

    position_m: Vector
    step_m: Vector


def arm_state(tcp_position_m: Vector, tcp_velocity_m_s: Vector) -> ArmState:
    """Return the model's state for a measured position and velocity."""
    return ArmState(tcp_position_m.copy(), tcp_velocity_m_s * STEP_SECONDS)


def advance(arm: ArmState, translation: Vector) -> ArmState:
    """Return where the arm is one control step later, given the (3,) translation part of an action."""
    step_m = arm.step_m + RESPONSE * (FULL_SPEED_M_PER_STEP * translation - arm.step_m)
    return ArmState(arm.position_m + (arm.step_m + step_m) / 2, step_m)


def action_row(translation: Vector, gripper: float) -> NDArray[np.float32]:
    """Return the (7,) action with this translation, no rotation and this gripper command."""
    row = np.zeros(N_ACTION_DIMS, dtype=np.float32)
    row[:3] = np.clip(translation, -1, 1)
    row[-1] = gripper
    return row
