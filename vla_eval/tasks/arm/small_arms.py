"""ManiSkill's SO-100 and Koch v1.1 at the table; importing it registers the arms.

ManiSkill's agents command arm and jaw by one controller. Here they are two, the last number of an action is
the gripper's in [-1, 1] as with every robot, and there are a tool centre point and a wrist camera.
"""

import hashlib
from pathlib import Path
from typing import Any, ClassVar  # ManiSkill is untyped
from xml.etree import ElementTree

import sapien
from mani_skill import PACKAGE_ASSET_DIR
from mani_skill.agents.controllers import PDJointPosControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.koch.koch import Koch
from mani_skill.agents.robots.so100.so_100 import SO100
from mani_skill.sensors.camera import CameraConfig

from vla_eval.control_modes import DELTA_RAD, JOINT_DELTA_POS, JOINT_POS
from vla_eval.features import IMAGE_SIZE_PX
from vla_eval.robots import rows
from vla_eval.robots.arm import Arm, Hinge
from vla_eval.storage.cache import cached
from vla_eval.storage.drafts import appearing
from vla_eval.tasks.arm.robots import KeptConfigs
from vla_eval.tasks.interface import CAMERA_FOV_RAD

TOOL_LINK = "tool_centre_point"
PACKAGE = "package://"  # in a URDF: the folder of the robot is a package


def urdf_with_tool(urdf: Path, *, link: str, tool: Hinge) -> Path:
    """Return a URDF with a tool centre point at a link, from the user's cache or new in it.

    The folder's name is a digest of the file and of what is added.
    """
    tree = ElementTree.parse(urdf)
    for mesh in tree.iter("mesh"):
        name = mesh.attrib["filename"]
        _, is_package, inside = name.rpartition(PACKAGE)
        mesh.set("filename", str(urdf.parents[1] / inside if is_package else urdf.parent / name))
    root = tree.getroot()
    joint = ElementTree.SubElement(root, "joint", name=f"{TOOL_LINK}_joint", type="fixed")
    xyz, rpy = (" ".join(map(str, numbers)) for numbers in (tool.origin_m, tool.rpy_rad))
    ElementTree.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
    ElementTree.SubElement(joint, "parent", link=link)
    ElementTree.SubElement(joint, "child", link=TOOL_LINK)
    ElementTree.SubElement(root, "link", name=TOOL_LINK)
    text = ElementTree.tostring(root)
    folder = cached(f"robots/{hashlib.sha256(text).hexdigest()[:16]}")
    file = folder / urdf.name
    if not file.exists():
        with appearing(folder) as draft:
            (draft / file.name).write_bytes(text)
            srdf = urdf.with_suffix(".srdf")
            (draft / srdf.name).write_bytes(srdf.read_bytes())
    return file


class _SmallArm(KeptConfigs):
    """What the small arms share: controllers for arm and jaw, a tool centre point and a wrist camera."""

    ROW: ClassVar[Arm]
    HAND_LINK: ClassVar[str]  # the link that tool centre point and camera are on
    CAMERA: ClassVar[sapien.Pose]  # of the camera, in the frame of the tool centre point
    STIFFNESS, DAMPING, FORCE_LIMIT = 1e3, 1e2, 100.0  # of ManiSkill's agents in `pd_joint_pos`

    # With the 100 N m of ManiSkill's agents the jaws, which stand at an angle, throw a cube of 4 cm out.
    JAW_FORCE_LIMIT_N_M: ClassVar[float]

    robot: Any
    ORIGINAL: ClassVar[Path]

    @property
    def urdf_path(self) -> str:
        """Path of the URDF; created when the first such arm is loaded."""
        assert self.ROW.chain is not None  # of every small arm
        return str(urdf_with_tool(self.ORIGINAL, link=self.HAND_LINK, tool=self.ROW.chain.tool))

    def _after_loading_articulation(self) -> None:
        super()._after_loading_articulation()  # type: ignore[misc]  # the arm's
        self.tcp = self.robot.links_map[TOOL_LINK]

    @property
    def _sensor_configs(self) -> list[CameraConfig]:
        """The wrist camera, behind the jaws, looking along them."""
        mount, size = self.robot.links_map[TOOL_LINK], (IMAGE_SIZE_PX, IMAGE_SIZE_PX)
        return [CameraConfig("hand_camera", self.CAMERA, *size, CAMERA_FOV_RAD, 0.01, 100, mount=mount)]

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
class SO100AtTable(_SmallArm, SO100):  # type: ignore[misc]  # ManiSkill is untyped
    """ManiSkill's SO-100 on the table."""

    ROW = rows.SO100
    (uid,) = ROW.uids
    ORIGINAL = Path(PACKAGE_ASSET_DIR) / "robots" / "so100" / "so100.urdf"
    HAND_LINK = "Fixed_Jaw"
    # Half of the stall torque of its servo at 7.4 V (Feetech STS3215, 19.5 kg cm), as LeRobot limits it
    # (`Max_Torque_Limit` in its SO follower).
    JAW_FORCE_LIMIT_N_M = 0.96
    CAMERA = sapien.Pose([0.05, 0, -0.1], [0.70710678, 0, -0.70710678, 0])


@register_agent()
class KochAtTable(_SmallArm, Koch):  # type: ignore[misc]  # ManiSkill is untyped
    """ManiSkill's Koch v1.1 on the table."""

    ROW = rows.KOCH
    (uid,) = ROW.uids
    ORIGINAL = Path(PACKAGE_ASSET_DIR) / "robots" / "koch" / "follower_arm_v1.1.urdf"
    HAND_LINK = "link_6"
    JAW_FORCE_LIMIT_N_M = 0.52  # stall torque of its servo (Dynamixel XL330-M288)
    CAMERA = sapien.Pose([0.05, 0, -0.08], [0.70710678, 0, -0.70710678, 0])
