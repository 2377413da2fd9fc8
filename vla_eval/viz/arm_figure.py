"""The Panda's arm as a line through its joints, for images without meshes."""

import numpy as np

from vla_eval.control_modes import N_ARM_JOINTS
from vla_eval.core import FloatArray
from vla_eval.oracles.kinematics import FLANGE_M, TCP_M, joint_poses

ROBOT_BASE_M = (-0.615, 0.0, 0.0)  # where the tasks put the Panda
SAME_PLACE_M = 0.01


def arm_points_m(qpos: FloatArray, tcp_position_m: FloatArray) -> FloatArray | None:
    """Return (10, 3): base, the seven joints, the flange and the tool centre point, in m, world frame.

    None if the line would not end at the simulator's tool centre point: it is another arm, or no arm at all.
    """
    if len(qpos) < N_ARM_JOINTS:
        return None
    poses = joint_poses(qpos)
    joints = poses[:, :3, 3]
    tips = [joints[-1] + poses[-1, :3, 2] * along_m for along_m in (FLANGE_M, FLANGE_M + TCP_M)]
    points = (np.stack([np.zeros(3), *joints, *tips]) + ROBOT_BASE_M).astype(np.float32)
    if np.linalg.norm(points[-1] - tcp_position_m) > SAME_PLACE_M:
        return None
    return points
