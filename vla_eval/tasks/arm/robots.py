"""The arm with its wrist camera, with meshes of that camera that render faster; arms that load again fast.

The camera's mesh takes most of the rendering time on a CPU (`camera_mesh`). Each variant replaces it, for
rendering only: physics and collision shapes are the same. The files are created on first use in the user's
cache.
"""

import functools
import hashlib
from pathlib import Path
from typing import Any, ClassVar  # ManiSkill is untyped
from xml.etree import ElementTree

from mani_skill import ASSET_DIR, PACKAGE_ASSET_DIR
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.panda.panda_wristcam import PandaWristCam
from mani_skill.utils.building.urdf_loader import URDFLoader

from vla_eval.errors import MissingDependencyError
from vla_eval.robots.arm import Arm
from vla_eval.storage.cache import cached
from vla_eval.storage.drafts import appearing
from vla_eval.tasks.arm.camera_mesh import (
    GRID_M,
    VISIBLE_FILE,
    MeshChange,
    simplified,
    without_hidden,
    write_binary_stl,
)

_PANDA_DIR = Path(PACKAGE_ASSET_DIR) / "robots" / "panda"
_CAMERA_MESH = "realsense2_description/meshes/d415.stl"


@functools.cache  # asked for at each reset, and the sources have 21 MB
def changed_urdf(name: str, change: MeshChange) -> Path:
    """Return the URDF of a variant of the Panda with a changed camera mesh, from the cache or new in it.

    The folder's name is a digest of its sources. Workers that start together cannot see a partial file.
    """
    source_urdf, stl = _PANDA_DIR / "panda_v3.urdf", (_PANDA_DIR / _CAMERA_MESH).read_bytes()
    digest = hashlib.sha256(f"{name} {GRID_M} {_PANDA_DIR}".encode() + source_urdf.read_bytes())
    digest.update(stl)
    digest.update(Path(__file__).with_name(VISIBLE_FILE).read_bytes())
    folder = cached(f"robots/{digest.hexdigest()[:16]}")
    urdf = folder / f"panda_v3_{name}.urdf"
    if urdf.exists():
        return urdf
    mesh_name = f"d415_{name}.stl"
    tree = ElementTree.parse(source_urdf)
    for mesh in tree.iter("mesh"):
        file = mesh.attrib["filename"]
        mesh.set("filename", str(folder / mesh_name if file == _CAMERA_MESH else _PANDA_DIR / file))
    with appearing(folder) as draft:
        write_binary_stl(draft / mesh_name, change(stl))
        tree.write(draft / urdf.name)
        (draft / f"panda_v3_{name}.srdf").write_bytes((_PANDA_DIR / "panda_v3.srdf").read_bytes())
    return urdf


def downloaded(arm: Arm, file: str) -> Path:
    """Return the path of a robot's file among ManiSkill's downloads, `xarm6/xarm6_robotiq.urdf`.

    Raises:
        MissingDependencyError: it is not there. Nothing is ever downloaded from here.
    """
    path = Path(ASSET_DIR) / "robots" / file
    if not path.is_file():
        raise MissingDependencyError(
            f"robot='{arm.name}': its meshes are not installed, expected {path}. Install them with "
            f"`python -m mani_skill.utils.download_asset {arm.asset}`, or use another robot."
        )
    return path


ParsedArms = dict[str, Any]
"""Path of a URDF -> what ManiSkill's loader made of it."""


class _KeptLoader(URDFLoader):  # type: ignore[misc]  # ManiSkill is untyped
    """Parses a file once: each episode has a new scene, and parsing took a third of its time."""

    parsed: ParsedArms

    def parse(self, urdf_file: str, srdf_file: Any = None, package_dir: Any = None) -> Any:
        if urdf_file not in self.parsed:
            self.parsed[urdf_file] = super().parse(urdf_file, srdf_file, package_dir)
            if not self.scene.can_render():
                # Materials keep SAPIEN's renderer, and the next environment may need it on another device.
                for builder in self.parsed[urdf_file]["articulation_builders"]:
                    for link in builder.link_builders:
                        link.visual_records.clear()
        for builder in self.parsed[urdf_file]["articulation_builders"]:
            builder.set_scene(self.scene)
        return self.parsed[urdf_file]


def kept_loader(scene: Any, parsed: ParsedArms) -> URDFLoader:
    """Return a loader for a scene that parses only what was not parsed before for the same environment."""
    loader = _KeptLoader()
    loader.set_scene(scene)
    loader.parsed = parsed
    return loader


class KeptConfigs:
    """An arm whose controllers' configurations are made once: ManiSkill copies all, twice per reset."""

    _made: ClassVar[dict[type, Any]] = {}

    @property
    def _controller_configs(self) -> dict[str, dict[str, Any]]:
        if type(self) not in self._made:
            self._made[type(self)] = super()._controller_configs  # type: ignore[misc]  # the arm's
        # ManiSkill takes parts out of the outer dictionaries.
        return {mode: dict(parts) for mode, parts in self._made[type(self)].items()}


@register_agent()
class PandaWristCamSeen(KeptConfigs, PandaWristCam):  # type: ignore[misc]  # ManiSkill is untyped
    """`panda_wristcam`, drawn without the triangles inside the camera's housing: the same images."""

    uid = "panda_wristcam_seen"

    @property
    def urdf_path(self) -> str:
        """Path of the URDF; created when the first such arm is loaded."""
        return str(changed_urdf("seen", without_hidden))


@register_agent()
class PandaWristCamLight(KeptConfigs, PandaWristCam):  # type: ignore[misc]  # ManiSkill is untyped
    """`panda_wristcam`, drawn with a simpler mesh of the camera: images differ a little."""

    uid = "panda_wristcam_light"

    @property
    def urdf_path(self) -> str:
        """Path of the URDF; created when the first such arm is loaded."""
        return str(changed_urdf("light", simplified))
