"""Ego3D position encoding: where in space, seen from the camera, each patch of an image is.

Legend: N images, P patches, D SigLIP's width. Each patch is 2 × 2 cells; a cell's point in space comes
from its mean depth and the camera's matrix. Source: Qu et al. 2025 (arXiv 2501.15830), section III-A.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.models.shared.precision import in_float32
from vla_eval.models.spatialvla.camera import back_projected
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
