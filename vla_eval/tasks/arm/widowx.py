"""ManiSkill's WidowX 250 S at the table; importing it registers the arm.

Its meshes are a download of ManiSkill, which nothing here starts.
"""

from pathlib import Path
from typing import Any

from mani_skill.agents.controllers import PDEEPoseControllerConfig, PDJointPosMimicControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.widowx.widowx import WidowX250S

from vla_eval.control_modes import DELTA_M, DELTA_RAD, EE_DELTA_POSE
from vla_eval.robots.rows import WIDOWX
from vla_eval.tasks.arm.hands import TOOL_LINK, ToolAdded
from vla_eval.tasks.arm.robots import downloaded

# Of ManiSkill's agent for scenes of BridgeData, `WidowX250SBridgeDatasetFlatTable`.
STIFFNESS = (1169.79, 730.0, 808.46, 1229.13, 1272.28, 1056.33)
DAMPING = (330.0, 180.0, 152.12, 309.62, 201.05, 269.51)
FORCE_LIMIT_N_M = (200.0, 200.0, 100.0, 100.0, 100.0, 100.0)
GRIPPER_STIFFNESS, GRIPPER_DAMPING, GRIPPER_FORCE_LIMIT_N = 1000.0, 200.0, 60.0


@register_agent()
class WidowXAtTable(ToolAdded, WidowX250S):  # type: ignore[misc]  # ManiSkill is untyped
    """ManiSkill's WidowX 250 S on the table, with a tool centre point, controllers and a wrist camera."""

    ROW = WIDOWX
    (uid,) = ROW.uids
    HAND_LINK, CAMERA_M = "ee_gripper_link", (0.06, 0.0, -0.1)

    def original_urdf(self) -> Path:
        """Return the path of the URDF among ManiSkill's downloads."""
        return downloaded(WIDOWX, "widowx/wx250s.urdf")

    @property
    def _controller_configs(self) -> dict[str, dict[str, Any]]:  # Any: ManiSkill's configurations
        arm = PDEEPoseControllerConfig(
            joint_names=self.arm_joint_names,
            pos_lower=-DELTA_M,
            pos_upper=DELTA_M,
            rot_lower=-DELTA_RAD,
            rot_upper=DELTA_RAD,
            stiffness=list(STIFFNESS),
            damping=list(DAMPING),
            force_limit=list(FORCE_LIMIT_N_M),
            ee_link=TOOL_LINK,
            urdf_path=self.urdf_path,
        )
        left, right = self.gripper_joint_names
        gripper = PDJointPosMimicControllerConfig(
            [left, right],
            lower=WIDOWX.gripper.closed,
            upper=WIDOWX.gripper.opened,
            stiffness=GRIPPER_STIFFNESS,
            damping=GRIPPER_DAMPING,
            force_limit=GRIPPER_FORCE_LIMIT_N,
            mimic={right: {"joint": left}},
        )
        return {EE_DELTA_POSE: {"arm": arm, "gripper": gripper}}
