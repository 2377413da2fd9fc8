"""The token heads: actions as tokens, all at once or one after the other, and their loss.

Legend as in `network`. Decoding is greedy, as the original's. Tokens are 255 bins over [-1, 1], the last of
the vocabulary, counted from behind. Source: https://github.com/moojink/openvla-oft/blob/
213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/prismatic/vla/action_tokenizer.py#L13-L72 and, for unknown tokens,
prismatic/extern/hf/modeling_prismatic.py#L877-L916.
"""

import torch
from torch import Tensor

from vla_eval.models.openvla.network import Inputs, OpenVLANetwork
from vla_eval.models.openvla.sizes import N_BINS
from vla_eval.models.shared.greedy import Prefix, greedy_tokens, token_cross_entropy


def parallel_actions(network: OpenVLANetwork, inputs: Inputs) -> Tensor:
    """Return normalised actions (B, K, A) of the tokens that are predicted for the placeholders."""
    hidden = network.action_states(network.sequence(inputs))
    tokens = network.logits(hidden).argmax(dim=-1)
    return _chunk(network, tokens)


def generated_actions(network: OpenVLANetwork, inputs: Inputs) -> Tensor:
    """Return normalised actions (B, K, A), predicted token after token, for prompts of several lengths."""
    sequence = network.sequence(inputs)
    n = int(sequence.first_action.max())
    lengths = sequence.first_action
    seen = torch.arange(n, device=lengths.device) < lengths[:, None]
    causal = torch.ones(n, n, dtype=torch.bool, device=lengths.device).tril()
    prefix = Prefix(sequence.embeddings[:, :n], seen[:, None, :] & causal, lengths)
    decoded = greedy_tokens(network, prefix, network.options.n_action_tokens)
    return _chunk(network, decoded.tokens)


def token_loss(network: OpenVLANetwork, inputs: Inputs, actions: Tensor, counts: Tensor) -> Tensor:
    """Return the cross-entropy of the tokens of normalised actions (B, K, A) and of the stop token.

    `counts` (B, K) is 0 for actions that are left out; the stop token counts as the last action.

    Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
    prismatic/vla/datasets/datasets.py#L32-L74: `predict_stop_token`, whichever way the tokens are predicted.
    """
    one_by_one = network.options.head == "tokens"
    ids = to_tokens(actions.flatten(1), network.sizes.text_vocabulary)
    sequence = network.sequence(inputs, ids if one_by_one else None)
    hidden = network.action_states(sequence, causal=one_by_one, n_more=1)
    ids = torch.cat([ids, torch.full_like(ids[:, :1], network.sizes.stop_token)], dim=1)
    weights = counts.repeat_interleave(network.options.action, dim=1)
    weights = torch.cat([weights, weights[:, -1:]], dim=1)
    return token_cross_entropy(network.logits(hidden).float(), ids, weights)


def _chunk(network: OpenVLANetwork, tokens: Tensor) -> Tensor:
    actions = from_tokens(tokens, network.sizes.text_vocabulary)
    return actions.reshape(len(tokens), network.options.chunk, network.options.action)


def to_tokens(actions: Tensor, text_vocabulary: int) -> Tensor:
    """Return the tokens (…) int64 of normalised actions (…); beyond [-1, 1]: the outermost."""
    edges = torch.linspace(-1, 1, N_BINS, dtype=torch.float64, device=actions.device)
    return text_vocabulary - torch.bucketize(actions.double().clamp(-1, 1), edges, right=True)


def from_tokens(tokens: Tensor, text_vocabulary: int) -> Tensor:
    """Return the normalised actions float32, the middles of the bins; a token that is none is the nearest."""
    edges = torch.linspace(-1, 1, N_BINS, dtype=torch.float64, device=tokens.device)
    middles = (edges[:-1] + edges[1:]) / 2
    # The value 1 alone is in a bin of its own, number 256; it shares the last middle.
    bins = (text_vocabulary - tokens - 1).clamp(0, N_BINS - 2)
    return middles[bins].float()
