"""ManiSkill's xArm 6 with a Robotiq gripper at the table; importing it registers the arm.

Its meshes are a download of ManiSkill, which nothing here starts.
"""

from dataclasses import dataclass
from typing import Any

import sapien
from mani_skill.agents.controllers import PDJointPosMimicController, PDJointPosMimicControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.xarm6.xarm6_robotiq import XArm6Robotiq
from mani_skill.sensors.camera import CameraConfig

from vla_eval.control_modes import EE_DELTA_POSE
from vla_eval.robots.rows import XARM6
from vla_eval.tasks.arm.fetch import StillConfig
from vla_eval.tasks.arm.hands import ALONG_THE_FINGERS_WXYZ, hand_camera
from vla_eval.tasks.arm.robots import KeptConfigs, downloaded

# 20 N at the pads, which move by 5 cm/rad: the least force of a Robotiq 2F-85 (20 to 235 N, its manual).
# With the 0.1 N m of ManiSkill's agent the fingers give way while they turn a peg.
GRIPPER_FORCE_LIMIT_N_M = 1.0
DRIVEN = ("left_outer_knuckle_joint", "right_outer_knuckle_joint")
PASSIVE = (
    *("left_inner_knuckle_joint", "right_inner_knuckle_joint"),
    *("left_inner_finger_joint", "right_inner_finger_joint"),
)


class _Reversed(PDJointPosMimicController):  # type: ignore[misc]  # ManiSkill is untyped
    """Joints whose largest position closes the gripper: the action -1."""

    action_space_low: Any
    action_space_high: Any

    def _clip_and_scale_action_space(self) -> None:
        super()._clip_and_scale_action_space()
        self.action_space_low, self.action_space_high = self.action_space_high, self.action_space_low


@dataclass
class _ReversedConfig(PDJointPosMimicControllerConfig):  # type: ignore[misc]  # ManiSkill is untyped
    controller_cls = _Reversed


@register_agent()
class XArm6AtTable(KeptConfigs, XArm6Robotiq):  # type: ignore[misc]  # ManiSkill is untyped
    """ManiSkill's xArm 6 with the gripper's number in [-1, 1] as with every robot, and a wrist camera."""

    (uid,) = XARM6.uids

    @property
    def urdf_path(self) -> str:
        """Path of the URDF among ManiSkill's downloads."""
        return str(downloaded(XARM6, "xarm6/xarm6_robotiq.urdf"))

    @property
    def _sensor_configs(self) -> list[CameraConfig]:
        """The wrist camera, beside the gripper, looking along it."""
        pose = sapien.Pose([0.07, 0.0, -0.12], ALONG_THE_FINGERS_WXYZ)
        return hand_camera(self.robot.links_map[self.ee_link_name], pose)

    @property
    def _controller_configs(self) -> dict[str, dict[str, Any]]:  # Any: ManiSkill's configurations
        gripper = _ReversedConfig(
            list(DRIVEN),
            lower=XARM6.gripper.opened,
            upper=XARM6.gripper.closed,
            stiffness=self.gripper_stiffness,
            damping=self.gripper_damping,
            force_limit=GRIPPER_FORCE_LIMIT_N_M,
            friction=self.gripper_friction,
            mimic={DRIVEN[0]: {"joint": DRIVEN[1]}},
        )
        still = StillConfig(list(PASSIVE), damping=0, friction=0)
        own = XArm6Robotiq._controller_configs.fget(self)
        return {EE_DELTA_POSE: {"arm": own[EE_DELTA_POSE]["arm"], "gripper": gripper, "still": still}}
