"""ManiSkill's SO-100 and Koch v1.1 at the table; importing it registers the arms.

ManiSkill's agents command arm and jaw by one controller. Here they are two, the last number of an action is
the gripper's in [-1, 1] as with every robot, and there are a tool centre point and a wrist camera.
"""

from pathlib import Path
from typing import Any, ClassVar  # ManiSkill is untyped

from mani_skill import PACKAGE_ASSET_DIR
from mani_skill.agents.controllers import PDJointPosControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.koch.koch import Koch
from mani_skill.agents.robots.so100.so_100 import SO100 as ManiSkillSO100

from vla_eval.control_modes import DELTA_RAD, JOINT_DELTA_POS, JOINT_POS
from vla_eval.robots.rows import KOCH, SO100
from vla_eval.tasks.arm.hands import ToolAdded


class _SmallArm(ToolAdded):
    """What the small arms share: controllers for arm and jaw."""

    STIFFNESS, DAMPING, FORCE_LIMIT = 1e3, 1e2, 100.0  # of ManiSkill's agents in `pd_joint_pos`

    # With the 100 N m of ManiSkill's agents the jaws, which stand at an angle, throw a cube of 4 cm out.
    JAW_FORCE_LIMIT_N_M: ClassVar[float]

    ORIGINAL: ClassVar[Path]

    def original_urdf(self) -> Path:
        """Return the path of ManiSkill's URDF, in its wheel."""
        return Path(PACKAGE_ASSET_DIR) / "robots" / self.ORIGINAL

    @property
    def _controller_configs(self) -> dict[str, dict[str, Any]]:  # Any: ManiSkill's configurations
        drive = {"stiffness": self.STIFFNESS, "damping": self.DAMPING, "force_limit": self.FORCE_LIMIT}
        joints, jaw = list(self.ROW.joints[:-1]), self.ROW.gripper
        drive_of_jaw = {**drive, "force_limit": self.JAW_FORCE_LIMIT_N_M}
        gripper = PDJointPosControllerConfig([self.ROW.joints[-1]], jaw.closed, jaw.opened, **drive_of_jaw)
        return {
            JOINT_POS: {
                "arm": PDJointPosControllerConfig(joints, None, None, normalize_action=False, **drive),
                "gripper": gripper,
            },
            JOINT_DELTA_POS: {
                "arm": PDJointPosControllerConfig(joints, -DELTA_RAD, DELTA_RAD, use_delta=True, **drive),
                "gripper": gripper,
            },
        }


@register_agent()
class SO100AtTable(_SmallArm, ManiSkillSO100):  # type: ignore[misc]  # ManiSkill is untyped
    """ManiSkill's SO-100 on the table."""

    ROW = SO100
    (uid,) = ROW.uids
    ORIGINAL = Path("so100/so100.urdf")
    HAND_LINK, CAMERA_M = "Fixed_Jaw", (0.05, 0.0, -0.1)
    # Half of the stall torque of its servo at 7.4 V (Feetech STS3215, 19.5 kg cm), as LeRobot limits it
    # (`Max_Torque_Limit` in its SO follower).
    JAW_FORCE_LIMIT_N_M = 0.96


@register_agent()
class KochAtTable(_SmallArm, Koch):  # type: ignore[misc]  # ManiSkill is untyped
    """ManiSkill's Koch v1.1 on the table."""

    ROW = KOCH
    (uid,) = ROW.uids
    ORIGINAL = Path("koch/follower_arm_v1.1.urdf")
    HAND_LINK, CAMERA_M = "link_6", (0.05, 0.0, -0.08)
    JAW_FORCE_LIMIT_N_M = 0.52  # stall torque of its servo (Dynamixel XL330-M288)
