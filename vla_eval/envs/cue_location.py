"""Where in an image the cue is: the places that a task names, projected. Knows nothing of policies."""

import itertools
import math
from typing import Any

import numpy as np

from vla_eval.cue_view import CueBoxes, PixelBox
from vla_eval.tasks.memory_env import CueSize, MemoryTableEnv, Place

MARGIN_PX = 1  # an edge's pixel may show some of the object
NEAR_M = 0.01  # what is nearer to the camera, or behind it, is not seen


def boxes_of_cue(env: MemoryTableEnv, row: int, cameras: tuple[str, ...]) -> CueBoxes:
    """Return the boxes that hold the cue of one parallel environment, in the images of these cameras."""
    places, size = env.cue_places_m(row), env.cue_size_m()
    found = {}
    for name in cameras:
        camera = env.scene.sensors[name].camera
        # (3, 4) world to camera in OpenCV's axes (z forward), and (3, 3) camera to pixels.
        extrinsic = camera.get_extrinsic_matrix()[row if env.gpu_sim_enabled else 0].cpu().numpy()
        intrinsic = camera.get_intrinsic_matrix()[row if env.gpu_sim_enabled else 0].cpu().numpy()
        edge_px = env.scene.sensors[name].config.width  # images are square
        boxes = (_box(place, size, intrinsic @ extrinsic, edge_px=edge_px) for place in places)
        found[name] = tuple(box for box in boxes if box is not None)
    return found


def _box(place: Place, size: CueSize, projection: np.ndarray[Any, Any], *, edge_px: int) -> PixelBox | None:
    """Return the box of the eight corners; None where nothing of it is in the image."""
    half, (x, y, z) = size.half_width_m, place
    corners = itertools.product((x - half, x + half), (y - half, y + half), (z, z + size.height_m))
    points = np.array([(*corner, 1.0) for corner in corners]) @ projection.T
    points = points[points[:, 2] > NEAR_M]
    if not len(points):
        return None
    columns, rows = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    top, bottom = _range(rows, edge_px)
    left, right = _range(columns, edge_px)
    return PixelBox(top, bottom, left, right) if top < bottom and left < right else None


def _range(values: np.ndarray[Any, Any], edge_px: int) -> tuple[int, int]:
    """Return the first pixel and the one after the last, within the image."""
    first, last = math.floor(values.min()) - MARGIN_PX, math.ceil(values.max()) + MARGIN_PX
    return min(max(first, 0), edge_px), min(max(last, 0), edge_px)
