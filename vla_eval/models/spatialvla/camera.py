"""Camera matrices, and points in space from depth. Knows only torch.

Camera frame: x to the right, y down, z ahead, in metres. Pixel (0, 0) is the corner of the first pixel.
"""

import math

import torch
from torch import Tensor

from vla_eval.errors import RecipeError
from vla_eval.models.shared.precision import in_float32


def intrinsics(*, height_px: int, width_px: int, fov_rad: float) -> Tensor:
    """Return the matrix (3, 3) of a centred pinhole camera with ManiSkill's vertical field of view."""
    if not 0 < fov_rad < math.pi:
        raise RecipeError(f"camera_fov_rad is {fov_rad}, expected radians in (0, π).")
    focal_px = height_px / 2 / math.tan(fov_rad / 2)
    return torch.tensor([[focal_px, 0, width_px / 2], [0, focal_px, height_px / 2], [0, 0, 1]])


@in_float32
def resized_intrinsics(matrix: Tensor, *, height_px: int, width_px: int, to_px: int) -> Tensor:
    """Return the matrix of images that were resized to `to_px` by `to_px`."""
    factors = torch.tensor([to_px / width_px, to_px / height_px, 1.0], dtype=matrix.dtype)
    return matrix * factors.to(matrix.device)[:, None]


@in_float32
def back_projected(depth: Tensor, matrices: Tensor, *, cell_px: float) -> Tensor:
    """Return points (B, rows, columns, 3) in the camera's frame, one at the middle of each cell.

    Depth (B, rows, columns) is metres along z; a cell of `cell_px` is one of the images of these matrices.
    """
    rows, columns = depth.shape[-2:]
    v = (torch.arange(rows, device=depth.device) + 0.5) * cell_px
    u = (torch.arange(columns, device=depth.device) + 0.5) * cell_px
    grid_v, grid_u = torch.meshgrid(v, u, indexing="ij")
    pixels = torch.stack([grid_u, grid_v, torch.ones_like(grid_u)], dim=-1).to(depth.dtype)
    rays = torch.einsum("bij,rcj->brci", torch.linalg.inv(matrices.to(depth.dtype)), pixels)
    return rays * depth[..., None]
