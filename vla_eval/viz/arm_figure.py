"""The Panda's arm as a line through its joints, for images without meshes."""

import math

import numpy as np

from vla_eval.core import FloatArray

ROBOT_BASE_M = (-0.615, 0.0, 0.0)  # where the tasks put the Panda
N_ARM_JOINTS = 7
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
SAME_PLACE_M = 0.01


def arm_points_m(qpos: FloatArray, tcp_position_m: FloatArray) -> FloatArray | None:
    """Return (10, 3): base, the seven joints, the flange and the tool centre point, world frame.

    Args:
        qpos: joint positions, rad; the first seven are the arm's.
        tcp_position_m: (3,) where the simulator has the tool centre point.

    Returns:
        None if the line would not end there: it is another arm, or no arm at all.
    """
    if len(qpos) < N_ARM_JOINTS:
        return None
    pose = np.eye(4)
    pose[:3, 3] = ROBOT_BASE_M
    points = [pose[:3, 3].copy()]
    for angle_rad, (a_m, d_m, alpha_rad) in zip(qpos, CHAIN_M_RAD, strict=False):
        pose = pose @ _step(float(angle_rad), a_m, d_m, alpha_rad)
        points.append(pose[:3, 3].copy())
    points += [pose[:3, 3] + pose[:3, 2] * along_m for along_m in (FLANGE_M, FLANGE_M + TCP_M)]
    if np.linalg.norm(points[-1] - tcp_position_m) > SAME_PLACE_M:
        return None
    return np.stack(points)


def _step(angle_rad: float, a_m: float, d_m: float, alpha_rad: float) -> FloatArray:
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
