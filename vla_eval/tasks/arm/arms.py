"""The arms that a task supports, a row each.

The Panda is the paper's and the default. `fetch_at_table` shows what another arm needs: a ManiSkill agent
with a tool centre point `tcp`, a camera `hand_camera`, two fingers as its last two joints and a controller
`pd_ee_delta_pose` of seven numbers; and its row here.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import torch
from gymnasium.spaces import Box
from mani_skill.agents.controllers import PassiveController, PassiveControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.fetch import Fetch
from mani_skill.sensors.camera import CameraConfig

from vla_eval.control_modes import CONTROL_MODES, EE_DELTA_POSE
from vla_eval.features import IMAGE_SIZE_PX, JOINT_NAMES
from vla_eval.tasks.arm.robots import WRIST_MESH_ROBOTS
from vla_eval.tasks.interface import CAMERA_FOV_RAD

FINGERS = ("finger1", "finger2")
FETCH_UID = "fetch_at_table"
HOLDING = 1e5  # N·s/m, N·m·s/rad: a joint with this damping does not move by itself


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """What a task needs to know about an arm.

    Attributes:
        joints: names of the entries of `qpos`; the last two are the fingers.
        arm_joints: indices of those that move the hand.
        rest_qpos: joint positions at the start of an episode, without noise; rad, and m for prismatic joints.
        base_m: position of the root, world frame.
        control_modes: those that it takes.
    """

    joints: tuple[str, ...]
    arm_joints: tuple[int, ...]
    rest_qpos: tuple[float, ...]
    base_m: tuple[float, float, float]
    control_modes: tuple[str, ...] = (EE_DELTA_POSE,)


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
        *FINGERS,
    ),
    arm_joints=(5, 7, 8, 9, 10, 11, 12),
    rest_qpos=(0.0, 0.0, 0.0, 0.386, 0.0, 0.0, 0.0, -1.0106, 0.0, 1.3855, 0.0, 0.1487, 0.0, 0.05, 0.05),
    base_m=(-1.02, 0.0, -0.9),
)


class _Still(PassiveController):  # type: ignore[misc]  # ManiSkill is untyped
    """Joints without a command; ManiSkill's own class uses a float64 box, for which Gymnasium warns."""

    def _initialize_action_space(self) -> None:
        none = np.empty(0, dtype=np.float32)
        self.single_action_space = Box(none, none, dtype=np.float32)


@dataclass
class _StillConfig(PassiveControllerConfig):  # type: ignore[misc]  # ManiSkill is untyped
    controller_cls = _Still


@register_agent()
class FetchAtTable(Fetch):  # type: ignore[misc]  # ManiSkill is untyped
    """ManiSkill's Fetch, standing still in front of the table: only its arm and gripper are commanded."""

    uid = FETCH_UID

    @property
    def _sensor_configs(self) -> list[CameraConfig]:
        """The wrist camera: on the hand, behind the fingers and above them, looking along them."""
        return [
            CameraConfig(
                uid="hand_camera",
                pose=sapien.Pose(p=[-0.1, 0, 0.1]),
                width=IMAGE_SIZE_PX,
                height=IMAGE_SIZE_PX,
                fov=CAMERA_FOV_RAD,
                near=0.01,
                far=100,
                mount=self.robot.links_map["gripper_link"],
            )
        ]

    @property
    def _controller_configs(self) -> dict[str, dict[str, Any]]:  # Any: ManiSkill's configurations
        """Fetch's own, except base, torso and head, which are held by damping and take no command."""
        still = _StillConfig(
            self.base_joint_names + self.body_joint_names, damping=HOLDING, force_limit=HOLDING
        )
        return {
            mode: {"arm": parts["arm"], "gripper": parts["gripper"], "still": still}
            for mode, parts in super()._controller_configs.items()
        }

    def is_static(self, threshold: float = 0.2) -> torch.Tensor:
        """Return (B,) bool: no joint of the arm is faster than the threshold.

        Fetch's own rule compares signed velocities, so any negative velocity passes.
        """
        speeds = self.robot.get_qvel()[:, list(FETCH.arm_joints)].abs()
        static: torch.Tensor = (speeds <= threshold).all(dim=1)
        return static


ARMS = {**dict.fromkeys(WRIST_MESH_ROBOTS.values(), PANDA), FETCH_UID: FETCH}
"""Value of `robot_uids` -> its row."""
