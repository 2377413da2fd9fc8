"""Give action tokens that move to another grid the embeddings that lie there. Knows nothing of networks.

When a grid is fitted again, token number n stands for another action. Its embedding is then read
from the old table at its new place: linearly along each of the three axes, between the middles of the old
bins, and at the outermost middle beyond it. The gripper's two rows stay.

The original interpolates over a Delaunay triangulation, which on a regular grid depends on the version of
SciPy, and takes the first two axes for each other; both are left out here (docs/spatialvla.md).
"""

import torch
from torch import Tensor

from vla_eval.errors import RecipeError
from vla_eval.models.spatialvla.action_grid import ROTATION, TRANSLATION, ActionGrid


def refitted(table: Tensor, old: ActionGrid, new: ActionGrid) -> Tensor:
    """Return the table (tokens, D) of the new grid, of as many bins, in the type of the old one."""
    if old.n_bins != new.n_bins:
        raise RecipeError(
            f"an action grid of {old.n_bins} bins cannot be moved to one of {new.n_bins}: the tokens would "
            "not be the same. Leave the numbers of bins in `sizes` as the base has them."
        )
    parts, begin = [], 0
    for axes in (TRANSLATION, ROTATION):
        shape = old.n_bins[axes]
        n = shape[0] * shape[1] * shape[2]
        cube = table[begin : begin + n].double().reshape(*shape, -1)
        for place, axis in enumerate(range(axes.start, axes.stop)):
            weights = _weights(old.centres(axis, table.device), new.centres(axis, table.device))
            cube = torch.tensordot(weights, cube.movedim(place, 0), dims=1).movedim(0, place)
        parts.append(cube.reshape(n, -1))
        begin += n
    return torch.cat([*parts, table[begin:].double()]).to(table.dtype)


def _weights(old: Tensor, new: Tensor) -> Tensor:
    """Return (n, n): how much each old bin counts in each new one; rows sum to 1."""
    places = new.clamp(old[0], old[-1])
    right = torch.bucketize(places, old, right=True).clamp(1, len(old) - 1)
    share = (places - old[right - 1]) / (old[right] - old[right - 1])
    weights = torch.zeros(len(new), len(old), dtype=old.dtype, device=old.device)
    weights.scatter_(1, (right - 1)[:, None], (1 - share)[:, None])
    return weights.scatter_(1, right[:, None], share[:, None])
