"""ELMUR: a transformer each of whose layers has a memory of slots that segments read and write.

Cherepanov et al. 2025, arXiv:2510.07151, as in offline_rl_baselines/ELMUR of
https://github.com/CognitiveAISystems/RATE (commit 8b80e4e), checked by golden values. Of that code's variants
it is the one of the MIKASA-Robo configurations: norms after sums, relative positions, experts.

A segment writes one slot per layer: the first that is empty, else the one that was written longest ago, which
keeps a share of what it held (arXiv:2510.07151; the code mixes it into an empty slot, too). Slots begin with
the same random numbers in every episode; in the source they are drawn again for each, also when it acts.

Shapes: B episodes, T tokens of a segment, S slots, L layers, W width, H heads.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.models.cores.core import CoreMemory, Segmented
from vla_eval.models.cores.relative_attention import (
    RelativeAttention,
    RelativeBiases,
    causal,
    distances_of,
    sinusoids,
)
from vla_eval.models.cores.sizes import ElmurOptions

NORM_EPS = 1e-8  # of the source's norms
EMPTY = -1  # when a slot was written that never was


class CrossAttention(nn.Module):
    """Attention of queries to keys with a bias for each pair and head."""

    def __init__(self, *, width: int, heads: int, dropout: float, attention_dropout: float) -> None:
        super().__init__()
        self.shape = (heads, width // heads)
        self.query = nn.Linear(width, width, bias=False)
        self.key = nn.Linear(width, width, bias=False)
        self.value = nn.Linear(width, width, bias=False)
        self.out = nn.Linear(width, width)
        self.drop, self.drop_weights = nn.Dropout(dropout), nn.Dropout(attention_dropout)
        nn.init.zeros_(self.out.bias)

    def forward(self, queries: Tensor, keys: Tensor, bias: Tensor) -> Tensor:
        """Return (B, Q, W) of queries (B, Q, W), keys (B, K, W) and a bias (B, Q, K, H)."""
        query = self.query(queries).unflatten(-1, self.shape)
        key = self.key(keys).unflatten(-1, self.shape)
        value = self.value(keys).unflatten(-1, self.shape)
        scores = torch.einsum("bqhd,bkhd->bhqk", query, key) / self.shape[1] ** 0.5
        weights = self.drop_weights((scores + bias.movedim(-1, 1)).softmax(dim=-1))
        returned: Tensor = self.drop(self.out(torch.einsum("bhqk,bkhd->bqhd", weights, value).flatten(-2)))
        return returned


class ElmurLayer(nn.Module):
    """One layer: tokens read each other, then the slots; then a slot reads the tokens."""

    def __init__(self, *, width: int, heads: int, dropout: float, options: ElmurOptions) -> None:
        super().__init__()
        weights = {"dropout": dropout, "attention_dropout": options.attention_dropout}
        sizes = {"width": width, "inner_width": options.inner_width, "experts": options.experts}
        self.attention = RelativeAttention(width=width, heads=heads, head_width=width // heads, **weights)
        self.reads = CrossAttention(width=width, heads=heads, **weights)
        self.writes = CrossAttention(width=width, heads=heads, **weights)
        self.feed_tokens = Experts(**sizes, dropout=dropout)
        self.feed_memory = Experts(**sizes, dropout=dropout)
        self.longest = options.longest
        self.bias = nn.Embedding(2 * options.longest - 1, heads)
        self.norms = nn.ModuleDict(
            {
                name: nn.LayerNorm(width, eps=NORM_EPS)
                for name in ("attention", "reads", "feed_tokens", "writes", "feed_memory")
            }
        )
        for module in (self.attention, self.reads, self.writes):
            for parameter in module.parameters():
                if parameter.ndim > 1:
                    nn.init.xavier_uniform_(parameter)

    def read(
        self,
        tokens: Tensor,
        slots: Tensor,
        *,
        apart: Tensor,
        allowed: Tensor,
        lag: Tensor,
        biases: RelativeBiases,
    ) -> Tensor:
        """Return tokens (B, T, W) after they have read each other and the slots (B, S, W).

        `lag` (B, T, S): tokens between a token and when a slot was written. `allowed`: (1, T, T). For the
        others, see `RelativeAttention`.
        """
        norms = self.norms
        tokens = norms["attention"](tokens + self.attention(tokens, tokens, apart, allowed, biases))
        tokens = norms["reads"](tokens + self.reads(tokens, slots, self._bias(lag)))
        tokens = norms["feed_tokens"](tokens + self.feed_tokens(tokens))
        return tokens

    def write(self, slot: Tensor, tokens: Tensor, *, lag: Tensor) -> Tensor:
        """Return what a slot (B, 1, W) would hold after tokens (B, T, W), with lags (B, 1, T)."""
        norms = self.norms
        written = norms["writes"](slot + self.writes(slot, tokens, self._bias(lag)))
        returned: Tensor = norms["feed_memory"](written + self.feed_memory(written))
        return returned

    def _bias(self, lag: Tensor) -> Tensor:
        biases: Tensor = self.bias(lag.clamp(1 - self.longest, self.longest - 1) + self.longest - 1)
        return biases


class Elmur(Segmented):
    """See the module's text."""

    empty_slots: Tensor

    def __init__(
        self, *, width: int, layers: int, heads: int, dropout: float, segment: int, options: ElmurOptions
    ) -> None:
        super().__init__(width=width, segment=segment)
        self.options = options
        self.layers = nn.ModuleList(
            ElmurLayer(width=width, heads=heads, dropout=dropout, options=options) for _ in range(layers)
        )
        self.biases = RelativeBiases(heads=heads, head_width=width // heads)
        self.drop, self.drop_written = nn.Dropout(dropout), nn.Dropout(options.memory_dropout)
        # Saved with the weights: what an episode begins with is a part of the policy.
        self.register_buffer("empty_slots", options.slot_scale * torch.randn(layers, options.slots, width))

    def begin_kept(self, n_episodes: int) -> CoreMemory:
        """Return slots (B, L, S, W), when each was written (B, S), and the segments that are over, (B,)."""
        n_segments = torch.zeros(n_episodes, dtype=torch.long, device=self.anchor.device)
        written = n_segments.new_full((n_episodes, self.options.slots), EMPTY)
        return self.empty_slots.expand(n_episodes, -1, -1, -1), written, n_segments

    def read_segment(self, tokens: Tensor, kept: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """See `Segmented`."""
        slots, written, n_segments = kept
        n_tokens, device = tokens.shape[1], tokens.device
        first = n_segments * n_tokens
        # The source numbers the tokens of a segment from the newest on, and adds the segment's beginning to
        # the distances between them.
        number = first[:, None] + torch.arange(n_tokens - 1, -1, -1, device=device)
        distances = first[:, None] + distances_of(n_tokens, n_tokens, device)
        apart = self.drop(sinusoids(distances, self.width))
        allowed = causal(n_tokens, n_tokens, device)[None]
        lag = number[:, :, None] - written[:, None, :]
        # The first of the oldest: numbers of slots decide between those that are as old.
        order = written * self.options.slots + torch.arange(self.options.slots, device=written.device)
        chosen = order.argmin(dim=1)
        is_empty = written.gather(1, chosen[:, None])[:, 0] == EMPTY
        index = chosen[:, None, None].expand(-1, 1, self.width)
        stream, after = self.drop(tokens), []
        for number_of_layer, layer in enumerate(self.layers):
            assert isinstance(layer, ElmurLayer)
            held = slots[:, number_of_layer]
            stream = layer.read(stream, held, apart=apart, allowed=allowed, lag=lag, biases=self.biases)
            slot = held.gather(1, index)
            lag_of_slot = lag.gather(2, chosen[:, None, None].expand(-1, n_tokens, 1))
            new = self.drop_written(layer.write(slot, stream, lag=-lag_of_slot.transpose(1, 2)))
            share = torch.where(is_empty, 1.0, self.options.blend)[:, None, None]
            after.append(held.scatter(1, index, torch.lerp(slot, new, share.to(new.dtype))))
        slots = torch.stack(after, dim=1)
        slots = slots if self.options.carries_gradient else slots.detach()
        written = written.scatter(1, chosen[:, None], number[:, :1])
        return stream, (slots, written, n_segments + 1)


class Experts(nn.Module):
    """A feed-forward layer: each token is sent to one of `experts`, and to one that takes all.

    Source: offline_rl_baselines/ELMUR/layers/mixture_of_experts.py at `top_k: 2` with one shared expert.
    There as here a single chosen expert has the weight 1, so that neither the loss nor the source's balancing
    term, which is left out, teaches the router anything: it stays the random partition that it begins as.
    """

    def __init__(self, *, width: int, inner_width: int, experts: int, dropout: float) -> None:
        super().__init__()
        # The last expert is the one for all tokens. Gated layers: Shazeer 2020, SwiGLU.
        self.gates = nn.Parameter(torch.empty(experts + 1, inner_width, width))
        self.values = nn.Parameter(torch.empty(experts + 1, inner_width, width))
        self.outs = nn.Parameter(torch.empty(experts + 1, width, inner_width))
        self.router = nn.Linear(width, experts, bias=False)
        for stack in (self.gates, self.values, self.outs):
            for weight in stack:
                nn.init.xavier_uniform_(weight)
        nn.init.xavier_uniform_(self.router.weight)
        self.router.requires_grad_(False)
        self.drop = nn.Dropout(dropout)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return (B, T, W) of tokens (B, T, W).

        All experts compute all tokens: a pass whose shapes depended on the choices would give a row other
        bits beside other rows.
        """
        chosen = functional.one_hot(self.router(tokens).argmax(dim=-1), self.router.out_features)
        taken = functional.pad(chosen, (0, 1), value=1).to(tokens.dtype)
        inner = functional.silu(torch.einsum("btw,efw->btef", tokens, self.gates))
        inner = self.drop(inner * torch.einsum("btw,efw->btef", tokens, self.values)) * taken[..., None]
        returned: Tensor = self.drop(torch.einsum("btef,ewf->btw", inner, self.outs))
        return returned
