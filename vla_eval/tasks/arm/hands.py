"""What an arm's hand has here: a wrist camera, and a tool centre point where ManiSkill's agent has none."""

import hashlib
from pathlib import Path
from typing import Any, ClassVar  # ManiSkill is untyped
from xml.etree import ElementTree

import sapien
from mani_skill.sensors.camera import CameraConfig

from vla_eval.features import IMAGE_SIZE_PX
from vla_eval.robots.arm import Arm, Hinge
from vla_eval.storage.cache import cached
from vla_eval.storage.drafts import appearing
from vla_eval.tasks.arm.robots import KeptConfigs
from vla_eval.tasks.interface import CAMERA_FOV_RAD

TOOL_LINK = "tool_centre_point"
PACKAGE = "package://"  # in a URDF: the folder of the robot is a package
ALONG_THE_FINGERS_WXYZ = (0.70710678, 0.0, -0.70710678, 0.0)  # cameras look along x, fingers along z


def hand_camera(mount: Any, pose: sapien.Pose) -> list[CameraConfig]:  # Any: a link of ManiSkill
    """Return the wrist camera, at a pose in the frame of a link."""
    size = (IMAGE_SIZE_PX, IMAGE_SIZE_PX)
    return [CameraConfig("hand_camera", pose, *size, CAMERA_FOV_RAD, 0.01, 100, mount=mount)]


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


class ToolAdded(KeptConfigs):
    """An arm whose URDF gets a tool centre point, with a wrist camera that looks along its fingers."""

    ROW: ClassVar[Arm]
    HAND_LINK: ClassVar[str]  # in whose frame the row has the tool centre point
    CAMERA_M: ClassVar[tuple[float, float, float]]  # of the camera, in the frame of the tool centre point

    robot: Any

    def original_urdf(self) -> Path:
        """Return the path of ManiSkill's URDF."""
        raise NotImplementedError

    @property
    def urdf_path(self) -> str:
        """Path of the URDF; created when the first such arm is loaded."""
        return str(urdf_with_tool(self.original_urdf(), link=self.HAND_LINK, tool=self.ROW.added_tool))

    def _after_loading_articulation(self) -> None:
        super()._after_loading_articulation()  # type: ignore[misc]  # the arm's
        self.tcp = self.robot.links_map[TOOL_LINK]

    @property
    def _sensor_configs(self) -> list[CameraConfig]:
        """The wrist camera."""
        pose = sapien.Pose(self.CAMERA_M, ALONG_THE_FINGERS_WXYZ)
        return hand_camera(self.robot.links_map[TOOL_LINK], pose)
