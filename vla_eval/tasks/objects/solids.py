"""A mesh as a body: its surfaces, in the frame of an item, and the convex hull that touches.

The frame's origin is in the middle of its height, and of the smallest circle around it in x and y; z is up.
Knows nothing of files.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import FloatArray

RGB = tuple[int, int, int]


class Surface(NamedTuple):
    """Triangles of one material."""

    vertices_m: FloatArray  # (V, 3)
    triangles: NDArray[np.uint32]  # (T, 3), indices of vertices
    normals: FloatArray  # (V, 3)
    uvs: FloatArray  # (V, 2), zeros without a texture
    rgb: RGB  # 0 to 255; multiplies the texture
    texture: NDArray[np.uint8] | None  # (H, W, 4), RGBA


class Solid(NamedTuple):
    """What is seen of a thing, and what touches: its mass is that of the hull, at 1,000 kg/m³."""

    surfaces: tuple[Surface, ...]
    hull_m: FloatArray  # (H, 3) corners
    height_m: float
