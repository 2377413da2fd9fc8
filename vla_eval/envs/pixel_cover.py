"""Which triangles of a mesh can colour a pixel of an image. Knows nothing of SAPIEN.

A rasteriser colours a pixel where a triangle covers its centre. Of a mesh that is much finer than the image,
nearly all triangles lie between centres: one whose corners are all between the same two columns of centres,
or the same two rows, covers none, whatever else is drawn. What is left out is certain; of what is kept, some
colours nothing, either. Backs of triangles are kept: SAPIEN draws them, and at edges they are seen.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Matrix = NDArray[np.float64]
Cells = NDArray[np.uint32]
Chosen = NDArray[np.bool_]

# px. Renderers place corners at multiples of 1/256 px, and both sides compute in float32.
MARGIN_PX = 0.02
NEAR_M = 0.01  # what is nearer to the camera may be anywhere in the image
# A place in the image is a number: that of its column of cells, then of its row, each with a mark.
ROW_BITS = 16
ROW, ROW_UNSURE, BEHIND = np.uint32(0x3FFF), np.uint32(1 << 15), np.uint32(1 << 14)
COLUMN, COLUMN_UNSURE = ROW << np.uint32(ROW_BITS), ROW_UNSURE << np.uint32(ROW_BITS)
UNSURE = COLUMN_UNSURE | ROW_UNSURE
LARGEST_PX = 8192  # so that a row of cells fits


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """A pinhole camera without skew; the centre of an image's first pixel is at 0.5."""

    focal_px: tuple[float, float]
    centre_px: tuple[float, float]  # from the left, from the top
    size_px: tuple[int, int]  # width, height
    near_m: float  # nothing nearer is drawn


@dataclass(frozen=True, slots=True, kw_only=True)
class Mesh:
    """Triangles of a body, in its frame."""

    points: Floats  # (3, P), m, none twice
    corners: tuple[
        NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]
    ]  # each (T,): a point of each triangle

    @classmethod
    def of(cls, vertices: Floats, triangles: NDArray[np.integer]) -> "Mesh":
        """Return the mesh of vertices (V, 3), of which many lie at the same place, and triangles (T, 3)."""
        points, place = _distinct(np.ascontiguousarray(vertices, np.float32))
        first, second, third = (np.ascontiguousarray(place[triangles[:, corner]]) for corner in range(3))
        return cls(points=np.ascontiguousarray(points.T), corners=(first, second, third))


def covering(mesh: Mesh, view: Matrix, lens: Lens) -> Chosen:
    """Return (T,) bool: False for triangles that colour no pixel, for certain.

    Args:
        mesh: the triangles.
        view: (4, 4) from the body's frame to the camera's: x ahead, y to the left, z up; m.
        lens: of the camera.
    """
    if max(lens.size_px) > LARGEST_PX:
        return np.ones(len(mesh.corners[0]), np.bool_)
    matrix = view.astype(np.float32)
    ahead, left, up = matrix[:3, :3] @ mesh.points + matrix[:3, 3:]
    is_near = ahead < np.float32(max(NEAR_M, lens.near_m))
    depth = np.where(is_near, np.float32(1), ahead)
    u_px, v_px = (
        np.float32(centre - 0.5) - np.float32(focal) * aside / depth
        for centre, focal, aside in zip(lens.centre_px, lens.focal_px, (left, up), strict=True)
    )
    width, height = lens.size_px
    place = _cells(u_px, width) << np.uint32(ROW_BITS) | _cells(v_px, height)
    place[is_near] |= UNSURE
    place[ahead < np.float32(lens.near_m / 2)] |= BEHIND
    first, second, third = (place.take(corner) for corner in mesh.corners)
    spans = (first ^ second) | (first ^ third)
    unsure = first | second | third
    spans_column = (spans & COLUMN) | (unsure & COLUMN_UNSURE) != 0
    spans_row = (spans & ROW) | (unsure & ROW_UNSURE) != 0
    is_behind = first & second & third & BEHIND != 0
    chosen: Chosen = spans_column & spans_row & ~is_behind
    return chosen


def _cells(place_px: Floats, n: int) -> Cells:
    """Return between which centres of n pixels a place lies, marked if it is too near to one to tell.

    Places are in pixels from the first centre. All that is outside on one side is one cell.
    """
    inside = np.clip(place_px, np.float32(-0.5), np.float32(n - 0.5))
    low = np.floor(inside - np.float32(MARGIN_PX))
    unsure = low != np.floor(inside + np.float32(MARGIN_PX))
    cells: Cells = (low + np.float32(1)).astype(np.uint32)
    cells[unsure] |= ROW_UNSURE
    return cells


def _distinct(vertices: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return the distinct ones of (V, 3), and where each is among them, (V,)."""
    # A hash is sorted ten times as fast as three numbers.
    bits = vertices.view(np.uint32).astype(np.uint64)
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    mixed = (bits * factors).sum(axis=1, dtype=np.uint64)
    _, first, place = np.unique(mixed, return_index=True, return_inverse=True)
    points, place = vertices[first], place.reshape(-1)
    if not np.array_equal(points[place].view(np.uint32), vertices.view(np.uint32)):  # two have one hash
        return vertices, np.arange(len(vertices))
    return points, place
