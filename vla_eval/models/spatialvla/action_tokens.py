"""Actions as three tokens: where to, how turned, gripper. Knows the grid, nothing of networks.

The translation's tokens come first, then the rotation's, then closed and open gripper. Within each the
last axis counts fastest. The gripper is 0 (closed) to 1 (open) here; `steps.gripper` makes that of
ManiSkill's -1 to +1, of which a threshold at 0.5 would make "open" only beyond a half.
"""

import torch
from torch import Tensor

from vla_eval.models.spatialvla.action_grid import (
    ROTATION,
    TRANSLATION,
    ActionGrid,
    from_spherical,
    to_spherical,
)
from vla_eval.models.spatialvla.sizes import N_ACTION, NetworkSizes

GRIPPER_THRESHOLD = 0.5  # open from here on


def to_tokens(actions: Tensor, grid: ActionGrid, sizes: NetworkSizes) -> Tensor:
    """Return tokens (…, 3) int64 of normalised actions (…, 7), cut to [-1, 1]; a gripper is from 0 to 1."""
    assert actions.shape[-1] == N_ACTION
    bounded = actions.double().clamp(-1, 1)
    values = torch.cat([to_spherical(bounded[..., TRANSLATION]), bounded[..., ROTATION]], dim=-1)
    bins = [grid.bins(axis, values[..., axis]) for axis in range(len(grid.edges))]
    n = grid.n_bins
    translation = (bins[0] * n[1] + bins[1]) * n[2] + bins[2]
    rotation = (bins[3] * n[4] + bins[4]) * n[5] + bins[5]
    gripper = (actions[..., -1] >= GRIPPER_THRESHOLD).long()
    return torch.stack([translation, rotation, gripper], dim=-1) + first_tokens(sizes, actions.device)


def from_tokens(tokens: Tensor, grid: ActionGrid, sizes: NetworkSizes) -> Tensor:
    """Return actions (…, 7), float64: middles of bins; a token of another column becomes the nearest."""
    limits = torch.tensor([sizes.n_translations, sizes.n_rotations, 2], device=tokens.device) - 1
    places = tokens - first_tokens(sizes, tokens.device)
    translation, rotation, gripper = torch.minimum(places.clamp(min=0), limits).unbind(dim=-1)
    n = grid.n_bins
    bins = (
        translation // (n[1] * n[2]),
        translation // n[2] % n[1],
        translation % n[2],
        rotation // (n[4] * n[5]),
        rotation // n[5] % n[4],
        rotation % n[5],
    )
    values = torch.stack(
        [grid.centres(axis, tokens.device)[index] for axis, index in enumerate(bins)], dim=-1
    )
    xyz = from_spherical(values[..., TRANSLATION]).clamp(-1, 1)
    return torch.cat([xyz, values[..., ROTATION], gripper[..., None].double()], dim=-1)


def first_tokens(sizes: NetworkSizes, device: torch.device) -> Tensor:
    """Return the first token (3,) of translations, rotations and grippers."""
    begin = sizes.first_action_token
    rotations = begin + sizes.n_translations
    return torch.tensor([begin, rotations, rotations + sizes.n_rotations], device=device)
