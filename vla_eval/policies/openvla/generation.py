"""The token heads: actions as tokens, all at once or one after the other, and the loss of telling them.

Legend as in `network`. Decoding is greedy, as the original's.
"""

import torch
from torch import Tensor
from torch.nn import functional
from transformers import DynamicCache

from vla_eval.policies.openvla.action_tokens import from_tokens, to_tokens
from vla_eval.policies.openvla.network import Inputs, OpenVLANetwork, Sequence


def parallel_actions(network: OpenVLANetwork, inputs: Inputs) -> Tensor:
    """Return normalised actions (B, K, A) of the tokens that the placeholders tell."""
    hidden = network.action_states(network.sequence(inputs))
    tokens = network.llm.lm_head(hidden).argmax(dim=-1)
    return _chunk(network, tokens)


def generated_actions(network: OpenVLANetwork, inputs: Inputs) -> Tensor:
    """Return normalised actions (B, K, A), told token after token.

    Prompts of several lengths go together: padding stands between a prompt and its tokens in the cache
    and is never attended to, and positions are counted without it.
    """
    llm, n_tokens = network.llm, network.options.n_action_tokens
    prefix = _prefix(network.sequence(inputs))
    lengths, n = prefix.first_action, prefix.mask.shape[1]
    cache = DynamicCache()
    causal = torch.ones(n, n, dtype=torch.bool, device=lengths.device).tril()
    answer = llm.model(
        inputs_embeds=prefix.embeddings,
        attention_mask=prefix.mask[:, None, None, :] & causal,
        position_ids=torch.arange(n, device=lengths.device)[None],
        past_key_values=cache,
        use_cache=True,
    )
    last = answer.last_hidden_state.take_along_dim((lengths - 1)[:, None, None], dim=1)
    tokens = [llm.lm_head(last).argmax(dim=-1)]
    mask = prefix.mask
    for step in range(n_tokens - 1):
        mask = torch.cat([mask, torch.ones_like(mask[:, :1])], dim=1)
        answer = llm.model(
            inputs_embeds=llm.model.embed_tokens(tokens[-1]),
            attention_mask=mask[:, None, None, :],
            position_ids=(lengths + step)[:, None],
            past_key_values=cache,
            use_cache=True,
        )
        tokens.append(llm.lm_head(answer.last_hidden_state).argmax(dim=-1))
    return _chunk(network, torch.cat(tokens, dim=1))


def token_loss(network: OpenVLANetwork, inputs: Inputs, actions: Tensor, counts: Tensor) -> Tensor:
    """Return the cross-entropy of the action tokens and, told one after the other, of the stop token.

    Args:
        network: with a token head.
        inputs: see there.
        actions: (B, K, A) normalised.
        counts: (B, K) float, 0 for actions that are left out.
    """
    one_by_one = network.options.head == "tokens"
    ids = to_tokens(actions.flatten(1), network.sizes.text_vocabulary)
    sequence = network.sequence(inputs, ids if one_by_one else None)
    weights = counts.repeat_interleave(network.options.action, dim=1)
    hidden = network.action_states(sequence, causal=one_by_one, n_more=int(one_by_one))
    if one_by_one:
        ids = torch.cat([ids, torch.full_like(ids[:, :1], network.sizes.stop_token)], dim=1)
        weights = torch.cat([weights, weights[:, -1:]], dim=1)
    logits = network.llm.lm_head(hidden).float()
    losses = functional.cross_entropy(logits.flatten(0, 1), ids.flatten(), reduction="none")
    return (losses * weights.flatten()).sum() / weights.sum().clamp(min=1)


def _prefix(sequence: Sequence) -> Sequence:
    """Return the sequence cut before the action tokens, whose places become padding where rows differ."""
    n = int(sequence.first_action.max())
    places = torch.arange(n, device=sequence.mask.device)
    return sequence._replace(
        embeddings=sequence.embeddings[:, :n], mask=places < sequence.first_action[:, None]
    )


def _chunk(network: OpenVLANetwork, tokens: Tensor) -> Tensor:
    actions = from_tokens(tokens, network.sizes.text_vocabulary)
    return actions.reshape(len(tokens), network.options.chunk, network.options.action)
