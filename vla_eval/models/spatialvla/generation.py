"""Action tokens: their loss, and predicting them one after the other.

Legend as in `network`. Decoding is greedy, as the original's. A chunk has a fixed length: exactly its tokens
are predicted, and only their columns' tokens are taken for it (`from_tokens`).

The translation's tokens come first, then the rotation's, then closed and open gripper. Within each the last
axis counts fastest. The gripper is 0 (closed) to 1 (open) here; `shared.gripper` makes that of ManiSkill's -1
to +1, of which a threshold at 0.5 would make "open" only beyond a half.
"""

import torch
from torch import Tensor

from vla_eval.models.shared.greedy import Decoded, Prefix, greedy_tokens, places_from, token_cross_entropy
from vla_eval.models.spatialvla.action_grid import (
    ROTATION,
    TRANSLATION,
    ActionGrid,
    from_spherical,
    to_spherical,
)
from vla_eval.models.spatialvla.network import Inputs, SpatialVLANetwork
from vla_eval.models.spatialvla.sizes import N_ACTION, TOKENS_PER_ACTION, Attention, NetworkSizes


def token_loss(
    network: SpatialVLANetwork,
    grid: ActionGrid,
    inputs: Inputs,
    actions: Tensor,
    counts: Tensor,
    attention: Attention,
) -> Tensor:
    """Return the mean cross-entropy of the tokens of actions (B, K, 7) and stop; `counts` 0 leaves out."""
    ids = to_tokens(actions, grid, network.sizes).flatten(1)
    sequence = network.sequence(inputs, ids)
    # A token is predicted at the place before it.
    hidden = places_from(network.hidden(sequence, attention), sequence.first_action - 1, ids.shape[1] + 1)
    wanted = torch.cat([ids, torch.full_like(ids[:, :1], network.sizes.stop_token)], dim=1)
    weights = torch.cat([counts.repeat_interleave(TOKENS_PER_ACTION, dim=1), counts[:, -1:]], dim=1)
    return token_cross_entropy(network.logits(hidden), wanted, weights)


def generated_tokens(
    network: SpatialVLANetwork, inputs: Inputs, *, chunk: int, attention: Attention
) -> Decoded:
    """Return a chunk's tokens (B, 3 · chunk); stop is never predicted, padding never attended to."""
    if attention == "bidirectional_with_padding":
        attention = "bidirectional"
    sequence = network.sequence(inputs)
    prefix = Prefix(sequence.embeddings, network.mask(sequence, attention), sequence.lengths)
    return greedy_tokens(network, prefix, chunk * TOKENS_PER_ACTION, never=(network.sizes.stop_token,))


def generated_actions(
    network: SpatialVLANetwork, grid: ActionGrid, inputs: Inputs, *, chunk: int, attention: Attention
) -> Tensor:
    """Return normalised actions (B, K, 7), float32, with the gripper 0 or 1."""
    decoded = generated_tokens(network, inputs, chunk=chunk, attention=attention)
    tokens = decoded.tokens.reshape(len(decoded.tokens), chunk, TOKENS_PER_ACTION)
    return from_tokens(tokens, grid, network.sizes).float()


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
