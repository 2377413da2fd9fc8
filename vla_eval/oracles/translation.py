"""From an action of `pd_ee_delta_pose`, in which the experts plan, to any other control mode."""

import numpy as np
from numpy.typing import NDArray

from vla_eval.control_modes import (
    DELTA_M,
    DELTA_RAD,
    EE_DELTA_POS,
    EE_DELTA_POSE,
    EE_POSE,
    JOINT_DELTA_POS,
    JOINT_POS,
    N_ARM_JOINTS,
    action_spec,
)
from vla_eval.oracles.arm_model import FULL_SPEED_M_PER_STEP, RESPONSE, STEP_SECONDS, Vector
from vla_eval.oracles.kinematics import from_euler_xyz, inverse, to_euler_xyz, tool_pose

SHARE_PER_STEP = FULL_SPEED_M_PER_STEP / DELTA_M
"""At a constant action, the share of the way to its target that the arm makes in one control step."""


def joint_target(mode: str, action: NDArray[np.float32], qpos: Vector) -> Vector:
    """Return the (7,) joint positions, rad, at which ManiSkill's controller aims.

    `action` is (A,) of the mode, the gripper last; of `qpos`, rad, the first seven are the arm's. They are
    returned if a pose is out of reach, as in ManiSkill.
    """
    arm = action_spec(mode).clipped(action)[:-1].astype(float)
    joints = np.array(qpos[:N_ARM_JOINTS], dtype=float)
    if mode == JOINT_POS:
        return arm
    if mode == JOINT_DELTA_POS:
        return joints + DELTA_RAD * arm
    pose = tool_pose(joints)
    if mode == EE_POSE:
        pose[:3, 3], pose[:3, :3] = arm[:3], from_euler_xyz(arm[3:])
    else:
        pose[:3, 3] += DELTA_M * arm[:3]
    if mode == EE_DELTA_POSE:
        turn = action[3:6].astype(float)
        turn /= max(float(np.linalg.norm(turn)), 1.0)  # ManiSkill bounds a rotation by its norm
        pose[:3, :3] = from_euler_xyz(-DELTA_RAD * turn) @ pose[:3, :3]
    found = inverse(pose, joints)
    return joints if found is None else found


def command(mode: str, target_rad: Vector, gripper: float, qpos: Vector) -> NDArray[np.float32]:
    """Return the action of a mode that aims at joint positions (7,), rad, from those of `qpos`.

    A delta mode goes as far towards them as its bounds allow, and `pd_ee_delta_pos` leaves the orientation
    as it is. `gripper` is the last number.
    """
    action_spec(mode)
    if mode == JOINT_POS:
        arm = target_rad
    elif mode == JOINT_DELTA_POS:
        arm = within_bounds((target_rad - qpos[:N_ARM_JOINTS]) / DELTA_RAD)
    else:
        arm = _tool_command(mode, target_rad, qpos)
    return np.array([*arm, gripper], dtype=np.float32)


def _tool_command(mode: str, target_rad: Vector, qpos: Vector) -> Vector:
    target = tool_pose(target_rad)
    if mode == EE_POSE:
        return np.concatenate([target[:3, 3], to_euler_xyz(target[:3, :3])])
    now = tool_pose(qpos)
    way = within_bounds((target[:3, 3] - now[:3, 3]) / DELTA_M)
    if mode == EE_DELTA_POS:
        return way
    return np.concatenate([way, to_euler_xyz(target[:3, :3] @ now[:3, :3].T) / -DELTA_RAD])


def translated(rows: NDArray[np.float32], mode: str, qpos: Vector, qvel: Vector) -> NDArray[np.float32]:
    """Return a chunk (T, 7) of `pd_ee_delta_pose` as one of another mode.

    What an action means depends on where the arm will be by then, which is predicted with the model of
    the arm that the experts plan with, applied to its joints: `qpos`, rad, and `qvel`, rad/s.
    """
    joints = np.array(qpos[:N_ARM_JOINTS], dtype=float)
    step_rad = np.array(qvel[:N_ARM_JOINTS], dtype=float) * STEP_SECONDS
    actions = []
    for row in rows:
        target = joint_target(EE_DELTA_POSE, row, joints)
        action = command(mode, target, float(row[-1]), joints)
        way = DELTA_RAD * action[:-1] if mode == JOINT_DELTA_POS else target - joints
        next_step_rad = step_rad + RESPONSE * (SHARE_PER_STEP * way - step_rad)
        joints, step_rad = joints + (step_rad + next_step_rad) / 2, next_step_rad
        actions.append(action)
    return np.stack(actions)


def within_bounds(numbers: Vector) -> Vector:
    """Return numbers in [-1, 1] in the same direction."""
    return numbers / max(float(np.abs(numbers).max()), 1.0)
