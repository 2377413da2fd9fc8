"""The Panda's kinematics: from joint positions to poses and back. Poses are (4, 4), in its base's frame."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_eval.control_modes import JOINT_HIGH_RAD, JOINT_LOW_RAD, N_ARM_JOINTS

Matrix = NDArray[np.float64]

# Denavit-Hartenberg parameters in Craig's convention, (a, d, alpha) of each joint, from the documentation of
# Franka Robotics (libfranka, "Robot and interface specifications", table of the Panda).
CHAIN_M_RAD = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -math.pi / 2),
    (0.0, 0.316, math.pi / 2),
    (0.0825, 0.0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0.0, 0.0, math.pi / 2),
    (0.088, 0.0, math.pi / 2),
)
FLANGE_M, TCP_M = 0.107, 0.1034  # along the last axis: to the flange, from there between the fingertips
HAND_TURN_RAD = -math.pi / 4  # of the hand about the last axis

MAX_ITERATIONS = 50
DAMPING = 1e-6  # of the normal equations: keeps a step finite where joints are aligned
CLOSE = 1e-4  # m and rad: the inverse is found


def joint_poses(qpos: ArrayLike) -> Matrix:
    """Return (7, 4, 4): the frame of each joint, whose z is its axis; of `qpos`, rad, seven are used."""
    pose, poses = np.eye(4), []
    arm_rad = np.asarray(qpos, dtype=float)[: len(CHAIN_M_RAD)]
    for angle_rad, (a_m, d_m, alpha_rad) in zip(arm_rad, CHAIN_M_RAD, strict=True):
        pose = pose @ _link(float(angle_rad), a_m, d_m, alpha_rad)
        poses.append(pose)
    return np.stack(poses)


def tool_pose(qpos: ArrayLike) -> Matrix:
    """Return the (4, 4) pose of the tool centre point."""
    return _tool(joint_poses(qpos))


def inverse(pose: Matrix, near_rad: ArrayLike) -> Matrix | None:
    """Return joint positions (7,), rad, for a tool pose (4, 4); None if it is out of reach.

    Newton's method with the pseudoinverse of the Jacobian: of all solutions one near to the start.
    """
    joints = np.array(near_rad, dtype=float)[:N_ARM_JOINTS]
    for _ in range(MAX_ITERATIONS):
        poses = joint_poses(joints)
        now = _tool(poses)
        error = np.concatenate([pose[:3, 3] - now[:3, 3], rotation_vector(pose[:3, :3] @ now[:3, :3].T)])
        if np.abs(error).max() <= CLOSE:
            return joints
        jacobian = _jacobian(poses, now[:3, 3])
        square = jacobian @ jacobian.T + DAMPING * np.eye(len(error))
        joints = joints + jacobian.T @ np.linalg.solve(square, error)
        joints = np.clip(joints, JOINT_LOW_RAD, JOINT_HIGH_RAD)
    return None


def rotation_vector(rotation: Matrix) -> Matrix:
    """Return (3,): axis times angle, rad, of a (3, 3) rotation by less than half a turn."""
    skew = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    twice_sine = float(np.linalg.norm(skew))
    if twice_sine == 0.0:
        return np.zeros(3)
    return skew / twice_sine * math.atan2(twice_sine, float(np.trace(rotation)) - 1)


def from_euler_xyz(angles_rad: ArrayLike) -> Matrix:
    """Return the (3, 3) rotation about x, then y, then z, each axis turning with the ones before."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles_rad), np.sin(angles_rad)
    return np.array(
        [
            [cy * cz, -cy * sz, sy],
            [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy],
            [sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy],
        ]
    )


def to_euler_xyz(rotation: Matrix) -> Matrix:
    """Return the (3,) angles that `from_euler_xyz` takes; the second in [-π/2, π/2]."""
    return np.array(
        [
            math.atan2(-rotation[1, 2], rotation[2, 2]),
            math.asin(min(max(rotation[0, 2], -1.0), 1.0)),
            math.atan2(-rotation[0, 1], rotation[0, 0]),
        ]
    )


def _tool(poses: Matrix) -> Matrix:
    cos, sin = math.cos(HAND_TURN_RAD), math.sin(HAND_TURN_RAD)
    hand = np.array([[cos, -sin, 0, 0], [sin, cos, 0, 0], [0, 0, 1, FLANGE_M + TCP_M], [0, 0, 0, 1]])
    tool: Matrix = poses[-1] @ hand
    return tool


def _jacobian(poses: Matrix, tool_m: Matrix) -> Matrix:
    """Return (6, 7): velocity and angular velocity of the tool per rad/s of each joint."""
    axes = poses[:, :3, 2]
    return np.vstack([np.cross(axes, tool_m - poses[:, :3, 3]).T, axes.T])


def _link(angle_rad: float, a_m: float, d_m: float, alpha_rad: float) -> Matrix:
    """Return the (4, 4) pose of a joint in the frame of the one before."""
    turn, lean = (math.cos(angle_rad), math.sin(angle_rad)), (math.cos(alpha_rad), math.sin(alpha_rad))
    return np.array(
        [
            [turn[0], -turn[1], 0, a_m],
            [turn[1] * lean[0], turn[0] * lean[0], -lean[1], -d_m * lean[1]],
            [turn[1] * lean[1], turn[0] * lean[1], lean[0], d_m * lean[0]],
            [0, 0, 0, 1],
        ]
    )
