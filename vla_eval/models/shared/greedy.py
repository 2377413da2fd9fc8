"""Greedy decoding after a prefix, for several rows at once. Knows torch and transformers' cache, no policy.

Legend: B rows, N places of the longest prefix, V tokens, D the language model's width.

Prefixes of several lengths go together: padding stands between a prefix and its tokens in the cache and is
never attended to, and positions are counted without it. So a row gets what it gets alone.
"""

from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn import functional
from transformers import DynamicCache


class Prompts(NamedTuple):
    """Prompts of B samples, without actions: ids (B, T), right-padded; the mask is False for padding."""

    ids: Tensor
    mask: Tensor


class Prefix(NamedTuple):
    """Embeddings (B, N, D), right-padded, which (B, N, N) places attend to which, and lengths (B,)."""

    embeddings: Tensor
    mask: Tensor
    lengths: Tensor


class Decoded(NamedTuple):
    """Tokens (B, T) int64 that were predicted, and the logits (B, T, V) that they were chosen from."""

    tokens: Tensor
    logits: Tensor


class LanguageModel(Protocol):
    """What decoding needs of a language model; places are counted from 0."""

    def embed(self, tokens: Tensor) -> Tensor:
        """Return the embeddings (B, T, D) of tokens (B, T)."""

    def read(self, embeddings: Tensor, mask: Tensor, places: Tensor, cache: DynamicCache | None) -> Tensor:
        """Return the last hidden states (B, T, D) at places (1 or B, T); the mask is (B, T, T + cached).

        The cache of the places before gets their keys and values; None: nothing came before, nothing is kept.
        """

    def logits(self, hidden: Tensor) -> Tensor:
        """Return (…, V) of hidden states (…, D)."""


def greedy_tokens(
    model: LanguageModel, prefix: Prefix, n_tokens: int, *, never: tuple[int, ...] = ()
) -> Decoded:
    """Return the likeliest tokens one after the other; those in `never` only have logits."""
    lengths, n = prefix.lengths, prefix.embeddings.shape[1]
    cache = DynamicCache()
    places = torch.arange(n, device=lengths.device)[None]
    hidden = model.read(prefix.embeddings, prefix.mask, places, cache)
    logits = [model.logits(hidden.take_along_dim((lengths - 1)[:, None, None], dim=1))]
    tokens = [_likeliest(logits[0], never)]
    seen = places < lengths[:, None]
    for step in range(n_tokens - 1):
        seen = torch.cat([seen, torch.ones_like(seen[:, :1])], dim=1)
        hidden = model.read(model.embed(tokens[-1]), seen[:, None, :], (lengths + step)[:, None], cache)
        logits.append(model.logits(hidden))
        tokens.append(_likeliest(logits[-1], never))
    return Decoded(torch.cat(tokens, dim=1), torch.cat(logits, dim=1))


def places_from(values: Tensor, first: Tensor, n: int) -> Tensor:
    """Return (B, n, D): of each row of (B, N, D), n places from `first` (B,) on."""
    places = first[:, None] + torch.arange(n, device=values.device)
    return values.take_along_dim(places[..., None], dim=1)


def token_cross_entropy(logits: Tensor, wanted: Tensor, weights: Tensor) -> Tensor:
    """Return the mean of the tokens' losses (B, T) by their weights, of logits (B, T, V)."""
    losses = functional.cross_entropy(logits.flatten(0, 1), wanted.flatten(), reduction="none")
    return (losses * weights.flatten()).sum() / weights.sum().clamp(min=1)


def _likeliest(logits: Tensor, never: tuple[int, ...]) -> Tensor:
    if never:
        logits = logits.clone()
        logits[..., list(never)] = -torch.inf
    return logits.argmax(dim=-1)
