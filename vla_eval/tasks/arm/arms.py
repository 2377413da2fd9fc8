"""The arms that a task supports, a row each. Knows nothing of simulators.

The Panda is the paper's and the default. `fetch_at_table` shows what another arm needs: a ManiSkill agent
with a tool centre point `tcp`, a camera `hand_camera`, two fingers as its last two joints and a controller
`pd_ee_delta_pose` of seven numbers (`fetch.py`); and its row here.
"""

from dataclasses import dataclass

import numpy as np

from vla_eval.config.environment import WristMesh
from vla_eval.control_modes import CONTROL_MODES, EE_DELTA_POSE
from vla_eval.features import JOINT_NAMES

FETCH_UID = "fetch_at_table"
WRIST_MESH_ROBOTS: dict[WristMesh, str] = {
    "shipped": "panda_wristcam_seen",
    "whole": "panda_wristcam",
    "simplified": "panda_wristcam_light",
}
"""Value of the render option `wrist_mesh` -> robot uid of the Panda with that mesh."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """What a task needs to know about an arm."""

    joints: tuple[str, ...]  # names of the entries of `qpos`; the last two are the fingers
    arm_joints: tuple[int, ...]  # indices of those that move the hand
    # joint positions at the start of an episode, without noise; rad, and m for prismatic joints
    rest_qpos: tuple[float, ...]
    base_m: tuple[float, float, float]  # position of the root, world frame
    control_modes: tuple[str, ...] = (EE_DELTA_POSE,)  # those that it takes


# Arm of the official code (mikasa_tasks section 1): tool centre point at (-0.07, 0, 0.318), pointing down.
PANDA = Arm(
    joints=JOINT_NAMES,
    arm_joints=tuple(range(7)),
    rest_qpos=(0.0, 0.0, 0.0, -2 * np.pi / 3, 0.0, 2 * np.pi / 3, np.pi / 4, 0.04, 0.04),
    base_m=(-0.615, 0.0, 0.0),
    control_modes=tuple(CONTROL_MODES),
)
# As close to the table as possible (from -1.00 m on they touch). The tool centre point is then at
# (-0.12, 0, 0.30), and the hand points 30 degrees down: pointing straight down it would not reach the cubes.
FETCH = Arm(
    joints=(
        *("root_x", "root_y", "root_turn", "torso", "head_pan", "shoulder_pan", "head_tilt"),
        *("shoulder_lift", "upperarm_roll", "elbow", "forearm_roll", "wrist", "wrist_roll"),
        *("finger1", "finger2"),
    ),
    arm_joints=(5, 7, 8, 9, 10, 11, 12),
    rest_qpos=(0.0, 0.0, 0.0, 0.386, 0.0, 0.0, 0.0, -1.0106, 0.0, 1.3855, 0.0, 0.1487, 0.0, 0.05, 0.05),
    base_m=(-1.02, 0.0, -0.9),
)

ARMS = {**dict.fromkeys(WRIST_MESH_ROBOTS.values(), PANDA), FETCH_UID: FETCH}
"""Value of `robot_uids` -> its row."""
