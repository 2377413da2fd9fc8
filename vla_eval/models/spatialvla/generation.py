"""Action tokens: their loss, and predicting them one after the other.

Legend as in `network`. Decoding is greedy, as the original's. A chunk has a fixed length: exactly its tokens
are predicted, and only their columns' tokens are taken for it (`action_tokens.from_tokens`).
"""

import torch
from torch import Tensor

from vla_eval.models.shared.greedy import Decoded, Prefix, greedy_tokens, places_from, token_cross_entropy
from vla_eval.models.spatialvla.action_grid import ActionGrid
from vla_eval.models.spatialvla.action_tokens import from_tokens, to_tokens
from vla_eval.models.spatialvla.network import Inputs, SpatialVLANetwork
from vla_eval.models.spatialvla.sizes import TOKENS_PER_ACTION, Attention


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
