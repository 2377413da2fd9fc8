"""Ego3D position encoding: where in space, seen from the camera, each patch of an image is.

Legend: N images, P patches, D SigLIP's width. Each patch is 2 × 2 cells; a cell's point in space comes
from its mean depth and the camera's matrix. A camera's frame is x to the right, y down, z ahead, in metres;
pixel (0, 0) is the corner of the first pixel. Source: Qu et al. 2025 (arXiv 2501.15830), section III-A.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.errors import RecipeError
from vla_eval.models.shared.precision import in_float32
from vla_eval.models.spatialvla.sizes import NetworkSizes

CELLS = 2  # per patch and direction
N_FREQUENCIES = 8  # 1, 2, 4 … 128, in radians per half metre
CENTRE_M = (0.0, 0.0, 2.0)  # what is subtracted from a point, and
SCALE_M = 2.0  # what it is divided by, before its frequencies are taken


class Ego3DEncoding(nn.Module):
    """Depth and camera matrices to what is added to the features of patches."""

    def __init__(self, sizes: NetworkSizes) -> None:
        super().__init__()
        self.sizes = sizes
        n_numbers = CELLS * CELLS * 3 * (1 + 2 * N_FREQUENCIES)
        width = sizes.siglip_width
        self.position_embedding_head = nn.Sequential(
            nn.Linear(n_numbers, width), nn.LayerNorm(width), nn.ReLU(), nn.Linear(width, width)
        )

    def forward(self, depth: Tensor, matrices: Tensor) -> Tensor:
        """Return (N, P, D) of depth (N, image_px, image_px) in metres and matrices (N, 3, 3)."""
        encoded = frequencies(patch_points(depth, matrices, self.sizes))
        first: nn.Linear = self.position_embedding_head[0]  # type: ignore[assignment]  # of a Sequential
        answer: Tensor = self.position_embedding_head(encoded.to(first.weight.dtype))
        return answer


@in_float32
def patch_points(depth: Tensor, matrices: Tensor, sizes: NetworkSizes) -> Tensor:
    """Return (N, P, 12): x, y, z of the cells of each patch, row by row, in metres."""
    n_side = sizes.image_px // sizes.patch_px
    cells = functional.interpolate(depth[:, None], size=(n_side * CELLS,) * 2, mode="area")[:, 0]
    points = back_projected(cells, matrices, cell_px=sizes.patch_px / CELLS)
    by_patch = points.reshape(len(depth), n_side, CELLS, n_side, CELLS, 3).transpose(2, 3)
    return by_patch.reshape(len(depth), n_side * n_side, CELLS * CELLS * 3)


@in_float32
def frequencies(points: Tensor) -> Tensor:
    """Return (…, 204) of points (…, 12) in metres: each coordinate, centred and scaled, its sines, cosines.

    In float32 whatever the network's precision: bfloat16 has no digits left of the fastest ones.
    """
    centre = torch.tensor(CENTRE_M * (points.shape[-1] // 3), device=points.device)
    coordinates = (points - centre) / SCALE_M
    angles = coordinates[..., None] * 2.0 ** torch.arange(N_FREQUENCIES, device=points.device)
    return torch.cat([coordinates[..., None], angles.sin(), angles.cos()], dim=-1).flatten(-2)


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
