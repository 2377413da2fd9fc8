"""From an action of `pd_ee_delta_pose`, in which the experts plan, to the joints of an arm without that mode.

The experts ask for a place of the hand, its turn about the vertical and a gap between the fingers. The hand
points down where the arm can reach the place like that, and is tilted as little as possible elsewhere.
"""

import math

import numpy as np
from numpy.typing import NDArray

from vla_eval.control_modes import DELTA_M, DELTA_RAD, JOINT_DELTA_POS
from vla_eval.oracles.arm_model import FINGER_HIGH_M, FINGER_LOW_M, RESPONSE, STEP_SECONDS, Vector
from vla_eval.oracles.chain import hand_pose, nearest_joints
from vla_eval.oracles.translation import SHARE_PER_STEP, within_bounds
from vla_eval.robots.arm import Arm

SIDEWAYS_RAD = 1.0  # off straight ahead: from here on, the way past the base leads back to the front
MOST_SWING_RAD = 0.6
MOST_STEP_RAD = 1.5  # that a joint is sent ahead: the arm makes two fifths of it in a control step


def joint_rows(
    rows: NDArray[np.float32], arm: Arm, mode: str, qpos: Vector, qvel: Vector
) -> NDArray[np.float32]:
    """Return a chunk (T, 7) of the experts as one of a joint mode of the arm, (T, A).

    Where the arm will be by then is predicted with the model of the arm that the experts plan with, applied
    to its joints: `qpos`, rad, and `qvel`, rad/s.
    """
    moving = list(arm.arm_joints)
    joints = np.array(qpos, dtype=float)[moving]
    step_rad = np.array(qvel, dtype=float)[moving] * STEP_SECONDS
    actions = []
    for row in rows:
        target = _target(arm, row, joints)
        way = target - joints
        numbers = target
        if mode == JOINT_DELTA_POS:
            numbers = within_bounds(way / DELTA_RAD)
            way = DELTA_RAD * numbers
        next_step_rad = step_rad + RESPONSE * (SHARE_PER_STEP * way - step_rad)
        joints, step_rad = joints + (step_rad + next_step_rad) / 2, next_step_rad
        actions.append([*numbers, arm.gripper.command(_gap_m(float(row[-1])))])
    return np.array(actions, dtype=np.float32)


def _target(arm: Arm, row: NDArray[np.float32], joints: Vector) -> Vector:
    """Return the (J,) joint positions, rad, at which the arm aims to do what a row of the experts says."""
    if not row[:-1].any():
        return joints
    hand = hand_pose(arm, joints)
    # ManiSkill multiplies rotations by their lower bound, so their sign is inverted.
    yaw_rad = math.atan2(hand.tool[1, 0], hand.tool[0, 0]) - DELTA_RAD * float(row[5])
    here_m = hand.tool[:3, 3]
    place_m = _around_the_base(here_m, here_m + DELTA_M * row[:3], hand.points_m[0], arm)
    way = nearest_joints(arm, place_m, yaw_rad, joints) - joints
    return joints + MOST_STEP_RAD * within_bounds(way / MOST_STEP_RAD)


def _around_the_base(here_m: Vector, place_m: Vector, axis_m: Vector, arm: Arm) -> Vector:
    """Return a place (3,), or if it is too near to the base one that leads past it in front.

    Straight past the base the first joint would have to turn in no time, and behind the base it cannot go.
    All in the world frame, whose x every robot faces; `axis_m` is on the axis of the first joint.
    """
    assert arm.chain is not None
    least_m = arm.chain.least_reach_m
    if math.hypot(*(place_m - axis_m)[:2]) >= least_m:
        return place_m
    (x, y), (step_x, step_y) = (here_m - axis_m)[:2], (place_m - here_m)[:2]
    angle_rad = math.atan2(y, x)
    to_the_left = x * step_y > y * step_x if abs(angle_rad) < SIDEWAYS_RAD else angle_rad < 0
    swing_rad = min(math.hypot(step_x, step_y) / least_m, MOST_SWING_RAD)
    angle_rad += swing_rad if to_the_left else -swing_rad
    x, y = axis_m[0] + least_m * math.cos(angle_rad), axis_m[1] + least_m * math.sin(angle_rad)
    return np.array([x, y, place_m[2]])


def _gap_m(command: float) -> float:
    """Return the gap between the fingers that a gripper command of the experts means, the Panda's."""
    return 2 * (FINGER_LOW_M + (command + 1) / 2 * (FINGER_HIGH_M - FINGER_LOW_M))
