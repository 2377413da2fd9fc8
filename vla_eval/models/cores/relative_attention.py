"""Attention that knows how far apart two tokens are: Transformer-XL's, as RATE and ELMUR use it.

Dai et al. 2019, "Transformer-XL", section 3.3. Checked against RATE/blocks/Attention.py and
offline_rl_baselines/ELMUR/layers/rel_partial_learnable_multihead_attn.py of
https://github.com/CognitiveAISystems/RATE (commits 5aa88f0 and 8b80e4e) by golden values.

Shapes: B episodes, Q queries, K keys, D distances, H heads, W width.
"""

import torch
from torch import Tensor, nn


def sinusoids(distances: Tensor, width: int) -> Tensor:
    """Return (…, width): sines, then cosines, of distances (…).

    Vaswani et al. 2017, section 3.5. A distance may be negative: to a key behind the query, which memory
    tokens read. (The source's shift of rows gives those keys the score of another pair.)
    """
    frequencies = 1 / 10_000 ** (torch.arange(0, width, 2, device=distances.device) / width)
    angles = distances[..., None].float() * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class RelativeBiases(nn.Module):
    """The two biases of all layers: of contents, and of distances."""

    def __init__(self, *, heads: int, head_width: int) -> None:
        super().__init__()
        self.content = nn.Parameter(torch.empty(heads, head_width))
        self.distance = nn.Parameter(torch.empty(heads, head_width))
        for bias in (self.content, self.distance):
            nn.init.xavier_uniform_(bias)


class RelativeAttention(nn.Module):
    """Attention of queries to keys, without a residual; dropout of what is returned, and of the weights."""

    def __init__(
        self, *, width: int, heads: int, head_width: int, dropout: float, attention_dropout: float
    ) -> None:
        super().__init__()
        self.shape = (heads, head_width)
        self.query = nn.Linear(width, heads * head_width, bias=False)
        self.key = nn.Linear(width, heads * head_width, bias=False)
        self.value = nn.Linear(width, heads * head_width, bias=False)
        self.distance = nn.Linear(width, heads * head_width, bias=False)
        self.out = nn.Linear(heads * head_width, width, bias=False)
        self.drop, self.drop_weights = nn.Dropout(dropout), nn.Dropout(attention_dropout)

    def forward(
        self, queries: Tensor, keys: Tensor, apart: Tensor, allowed: Tensor, biases: RelativeBiases
    ) -> Tensor:
        """Return (B, Q, W) of queries (B, Q, W), which are the last Q of the keys (B, K, W).

        `apart` (1 or B, D, W) is of the distances from 1 - Q to K - 1, see `sinusoids`; `allowed` (1 or B, Q,
        K) leaves each query at least one key.
        """
        n_queries, n_keys = queries.shape[1], keys.shape[1]
        query = self.query(queries).unflatten(-1, self.shape)
        key = self.key(keys).unflatten(-1, self.shape)
        value = self.value(keys).unflatten(-1, self.shape)
        contents = torch.einsum("bqhd,bkhd->bhqk", query + biases.content, key)
        # Of a product with each distance, the one with the distance between query and key.
        by_distance = torch.einsum(
            "bqhd,brhd->bhqr",
            query + biases.distance,
            self.distance(apart).unflatten(-1, self.shape).expand(len(queries), -1, -1, -1),
        )
        places = torch.arange(n_keys, device=keys.device)
        index = (places[-n_queries:, None] - places[None, :]) + n_queries - 1
        distances = by_distance.gather(-1, index.expand(*contents.shape))
        scores = (contents + distances) / self.shape[1] ** 0.5
        weights = scores.masked_fill(~allowed[:, None], float("-inf")).softmax(dim=-1)
        read = torch.einsum("bhqk,bkhd->bqhd", self.drop_weights(weights), value)
        returned: Tensor = self.drop(self.out(read.flatten(-2)))
        return returned


def distances_of(n_queries: int, n_keys: int, device: torch.device) -> Tensor:
    """Return (D,) the distances from the last `n_queries` of the keys to all keys, in order."""
    return torch.arange(1 - n_queries, n_keys, device=device)


def causal(n_queries: int, n_keys: int, device: torch.device) -> Tensor:
    """Return (Q, K) bool: each of the last `n_queries` places reads itself and what is before it."""
    places = torch.arange(n_keys, device=device)
    return places[None, :] <= places[-n_queries:, None]
