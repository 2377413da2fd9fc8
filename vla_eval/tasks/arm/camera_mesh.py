"""Meshes of the wrist camera's housing that render faster than the one that ManiSkill ships.

The shipped mesh (`d415.stl`) holds 425,160 of the scene's 581,280 triangles. Most of them are screws, boards
and lenses inside a closed housing. `without_hidden` leaves out the triangles that no view from outside shows:
every image is equal to the bit. The lights cast no shadows, so no light needs them either. Only a camera less
than 1 cm from the housing, its near plane, would look inside. `simplified` makes a simpler mesh, whose images
differ a little.

Which triangles a view from outside shows was found by casting rays (`scripts/visible_triangles.py`); the
result is `d415_visible.bin`, a bit per triangle of that file alone: another `d415.stl` is drawn whole.
"""

import hashlib
import logging
import struct
import zlib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import FloatArray

logger = logging.getLogger(__name__)

GRID_M = 0.0015  # finer than a pixel of the base camera at the arm, about 8 mm
VISIBLE_FILE = "d415_visible.bin"
KNOWN_SHA256 = "5ffbe0d4b4ffee3133b4b55b1fa68c053e46d186f4a4d2b4c0174a89f423481c"  # mani_skill 3.0.1
HEADER_BYTES = 80
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
"""One triangle of a binary STL file."""

Triangles = NDArray[Any]  # records of `RECORD`
MeshChange = Callable[[bytes], Triangles]
"""Takes the bytes of `d415.stl`, returns the triangles to draw."""


def without_hidden(stl: bytes) -> Triangles:
    """Return the triangles that a view from outside can show, as they are and in their order."""
    triangles = read_binary_stl(stl)
    if hashlib.sha256(stl).hexdigest() != KNOWN_SHA256:
        logger.debug("the mesh is not that of mani_skill 3.0.1: all of it is drawn")
        return triangles
    return triangles[visible(len(triangles))]


def simplified(stl: bytes) -> Triangles:
    """Return fewer and larger triangles, with the normals of their planes."""
    corners = snap_to_grid(read_binary_stl(stl)["corners"], GRID_M)
    out = np.zeros(len(corners), RECORD)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    out["normal"] = normals / np.where(lengths > 0, lengths, 1)
    out["corners"] = corners
    return out


def visible(n_triangles: int) -> NDArray[np.bool_]:
    """Return (n_triangles,) bool: which triangles of the known mesh a view from outside can show."""
    packed = zlib.decompress((resources.files("vla_eval.tasks.arm") / VISIBLE_FILE).read_bytes())
    return np.unpackbits(np.frombuffer(packed, np.uint8), count=n_triangles).astype(bool)


def snap_to_grid(triangles: FloatArray, grid_m: float) -> FloatArray:
    """Simplify triangles (T, 3, 3), m, by moving vertices to the mean of their grid cell.

    The result has no triangles that collapsed and no duplicates, in a fixed order.
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
    snapped: FloatArray = means[cells].astype(np.float32)
    return snapped


def read_binary_stl(stl: bytes) -> Triangles:
    """Return the (T,) triangles of a binary STL file."""
    (count,) = struct.unpack_from("<I", stl, HEADER_BYTES)
    return np.frombuffer(stl, RECORD, count=count, offset=HEADER_BYTES + 4)


def write_binary_stl(path: Path, triangles: Triangles) -> None:
    """Write triangles as a binary STL file."""
    path.write_bytes(b"\0" * HEADER_BYTES + struct.pack("<I", len(triangles)) + triangles.tobytes())
