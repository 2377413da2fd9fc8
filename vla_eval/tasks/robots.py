"""The arms: ManiSkill's Panda with a wrist camera, and the same with a lighter mesh of that camera.

The camera's mesh (`d415.stl`) holds 425,160 of the scene's 581,280 triangles and most of the rendering
time on a CPU. The light variant replaces it, for rendering only, by one whose vertices are snapped to a
grid of `GRID_M`. Physics, collision shapes and the wrist camera's view are the same; the base camera sees
slightly different pixels on the camera's body. The file is created on first use in the user's cache.
"""

import functools
import hashlib
import os
import struct
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from mani_skill import PACKAGE_ASSET_DIR
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.panda.panda_wristcam import PandaWristCam

from vla_eval.core import FloatArray
from vla_eval.storage.cache import cache_dir

GRID_M = 0.0015  # finer than a pixel of the base camera at the arm, about 8 mm
_PANDA_DIR = Path(PACKAGE_ASSET_DIR) / "robots" / "panda"
_CAMERA_MESH = "realsense2_description/meshes/d415.stl"


def snap_to_grid(triangles: FloatArray, grid_m: float) -> FloatArray:
    """Simplify a triangle soup by moving vertices to the mean of their grid cell.

    Args:
        triangles: (T, 3, 3) float32 corner positions in m.
        grid_m: edge of a cell.

    Returns:
        (T', 3, 3) float32, without triangles that collapsed and without duplicates, in a fixed order.
    """
    corners = triangles.reshape(-1, 3).astype(np.float64)
    _, cell_of_corner = np.unique(np.floor(corners / grid_m).astype(np.int64), axis=0, return_inverse=True)
    cell_of_corner = cell_of_corner.reshape(-1)
    counts = np.bincount(cell_of_corner)
    means = np.stack([np.bincount(cell_of_corner, corners[:, axis]) / counts for axis in range(3)], axis=1)
    cells = cell_of_corner.reshape(-1, 3)
    distinct = (cells[:, 0] != cells[:, 1]) & (cells[:, 1] != cells[:, 2]) & (cells[:, 0] != cells[:, 2])
    cells = cells[distinct]
    # Rotate each triangle so that its smallest cell comes first: keeps the winding, reveals duplicates.
    first = cells.argmin(axis=1)
    order = (first[:, None] + np.arange(3)) % 3
    cells = np.unique(np.take_along_axis(cells, order, axis=1), axis=0)
    simplified: FloatArray = means[cells].astype(np.float32)
    return simplified


def read_binary_stl(path: Path) -> FloatArray:
    """Return the (T, 3, 3) float32 corners of a binary STL file."""
    raw = path.read_bytes()
    (count,) = struct.unpack_from("<I", raw, 80)
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    corners: FloatArray = np.frombuffer(raw, record, count=count, offset=84)["corners"]
    return corners


def write_binary_stl(path: Path, triangles: FloatArray) -> None:
    """Write (T, 3, 3) float32 corners as a binary STL file with face normals."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    out = np.zeros(len(triangles), record)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    out["normal"] = normals / np.where(lengths > 0, lengths, 1)
    out["corners"] = triangles
    path.write_bytes(b"\0" * 80 + struct.pack("<I", len(triangles)) + out.tobytes())


@functools.cache  # asked for at each reset, and the sources have 21 MB
def light_urdf() -> Path:
    """Return the URDF of the Panda with the light camera mesh; create it if it is not in the cache.

    The folder's name is a digest of its sources. It is created atomically by a rename, so workers that
    start together cannot see a partial file.
    """
    source_mesh, source_urdf = _PANDA_DIR / _CAMERA_MESH, _PANDA_DIR / "panda_v3.urdf"
    digest = hashlib.sha256(f"{GRID_M} {_PANDA_DIR}".encode() + source_urdf.read_bytes())
    digest.update(source_mesh.read_bytes())
    folder = cache_dir() / "robots" / digest.hexdigest()[:16]
    urdf = folder / "panda_v3_light.urdf"
    if urdf.exists():
        return urdf
    draft = folder.with_name(f"{folder.name}.{os.getpid()}.tmp")
    draft.mkdir(parents=True, exist_ok=True)
    write_binary_stl(draft / "d415_light.stl", snap_to_grid(read_binary_stl(source_mesh), GRID_M))
    tree = ElementTree.parse(source_urdf)
    for mesh in tree.iter("mesh"):
        name = mesh.attrib["filename"]
        light = name == _CAMERA_MESH
        mesh.set("filename", str(folder / "d415_light.stl") if light else str(_PANDA_DIR / name))
    tree.write(draft / urdf.name)
    (draft / "panda_v3_light.srdf").write_bytes((_PANDA_DIR / "panda_v3.srdf").read_bytes())
    try:
        draft.rename(folder)
    except OSError:
        if not urdf.exists():  # otherwise another worker was faster
            raise
    return urdf


@register_agent()
class PandaWristCamLight(PandaWristCam):  # type: ignore[misc]  # ManiSkill is untyped
    """`panda_wristcam`, rendered with fewer triangles."""

    uid = "panda_wristcam_light"

    @property
    def urdf_path(self) -> str:
        """Path of the URDF; created when the first such arm is loaded."""
        return str(light_urdf())


WRIST_MESH_ROBOTS = {"shipped": "panda_wristcam", "simplified": "panda_wristcam_light"}
"""Value of the render option `wrist_mesh` -> robot uid."""
