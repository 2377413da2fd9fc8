"""Decision Transformer, RATE and GTrXL: layers of Transformer-XL over segments, and what each keeps.

- Decision Transformer (Chen et al. 2021) keeps nothing: a segment is the last so many steps.
- RATE (Cherepanov et al. 2024, arXiv:2306.09459) keeps hidden states of earlier segments, which its tokens
  read, and memory tokens, which a segment reads at its beginning and writes at its end. A valve (attention of
  the old memory tokens to what was written) may stand between the two.
- GTrXL (Parisotto et al. 2020, "Stabilizing Transformers for Reinforcement Learning") keeps hidden states;
  gates stand where other transformers add.

All three as in https://github.com/CognitiveAISystems/RATE (commit 5aa88f0, RATE/), checked by golden values.
There, no gradient reaches what a segment has written: what is written is never taught. Here it does unless
`carries_gradient` is false.

Shapes: B episodes, S tokens of a segment, M memory tokens, C cached tokens, L layers, W width.
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
from vla_eval.models.cores.sizes import TransformerXLOptions


class GruGate(nn.Module):
    """Lets a sublayer's output into the stream; at first hardly: Parisotto et al. 2020, section 3.2."""

    BIAS = 2.0  # of their section 4.1; the gate is nearly shut at the beginning

    def __init__(self, width: int) -> None:
        super().__init__()
        self.of_output = nn.Linear(width, 3 * width, bias=False)  # reset, update, candidate
        self.of_stream = nn.Linear(width, 2 * width, bias=False)  # reset, update
        self.of_reset_stream = nn.Linear(width, width, bias=False)
        self.bias = nn.Parameter(torch.full((width,), self.BIAS))

    def forward(self, stream: Tensor, output: Tensor) -> Tensor:
        """Return (…, W) of two of (…, W)."""
        reset, update, candidate = self.of_output(output).chunk(3, dim=-1)
        more_reset, more_update = self.of_stream(stream).chunk(2, dim=-1)
        opened = (update + more_update - self.bias).sigmoid()
        kept = (reset + more_reset).sigmoid() * stream
        return torch.lerp(stream, (candidate + self.of_reset_stream(kept)).tanh(), opened)


class Layer(nn.Module):
    """A layer of the source: sums are normalised; `gated`: GTrXL's order, norm, sublayer, ReLU, gate."""

    def __init__(self, *, width: int, heads: int, dropout: float, options: TransformerXLOptions) -> None:
        super().__init__()
        self.attention = RelativeAttention(
            width=width,
            heads=heads,
            head_width=options.head_width,
            dropout=dropout,
            attention_dropout=options.attention_dropout,
        )
        self.norm = nn.LayerNorm(width)
        self.gates = nn.ModuleList(GruGate(width) for _ in range(2 if options.gated else 0))
        self.feed: nn.Sequential | None = None
        if options.inner_width:
            self.feed_norm = nn.LayerNorm(width)
            self.feed = nn.Sequential(
                nn.Linear(width, options.inner_width),
                nn.ReLU(),
                nn.Dropout(dropout),
                nn.Linear(options.inner_width, width),
                nn.Dropout(dropout),
            )

    def forward(
        self, tokens: Tensor, cached: Tensor, apart: Tensor, allowed: Tensor, biases: RelativeBiases
    ) -> Tensor:
        """Return (B, Q, W) of tokens (B, Q, W) and cached ones before them (B, C, W)."""
        if self.gates:
            return self._gated(tokens, cached, apart, allowed, biases)
        keys = torch.cat([cached, tokens], dim=1)
        attended = tokens + self.attention(tokens, keys, apart, allowed, biases)
        stream: Tensor = self.norm(tokens + attended)
        if self.feed is not None:
            stream = self.feed_norm(stream + self.feed(stream))
        return stream

    def _gated(
        self, tokens: Tensor, cached: Tensor, apart: Tensor, allowed: Tensor, biases: RelativeBiases
    ) -> Tensor:
        assert self.feed is not None
        normed = self.norm(tokens)
        keys = torch.cat([cached, normed], dim=1)
        attended = normed + self.attention(normed, keys, apart, allowed, biases)
        stream = self.gates[0](tokens, functional.relu(attended))
        fed = functional.relu(self.feed(self.feed_norm(stream)))
        gated: Tensor = self.gates[1](stream, fed)
        return gated


class TransformerXL(Segmented):
    """See the module's text."""

    def __init__(
        self,
        *,
        width: int,
        layers: int,
        heads: int,
        dropout: float,
        segment: int,
        overlap: int = 0,
        options: TransformerXLOptions,
    ) -> None:
        super().__init__(width=width, segment=segment, overlap=overlap)
        self.options, self.drop = options, nn.Dropout(dropout)
        self.layers = nn.ModuleList(
            Layer(width=width, heads=heads, dropout=dropout, options=options) for _ in range(layers)
        )
        self.biases = RelativeBiases(heads=heads, head_width=options.head_width)
        self.first_memory: nn.Parameter | None = None
        if options.memory_tokens:
            # As in the source: all begin as the same one.
            self.first_memory = nn.Parameter(torch.randn(1, width).repeat(options.memory_tokens, 1))
        self.valve: nn.MultiheadAttention | None = None
        if options.valve_heads:
            self.valve = nn.MultiheadAttention(
                width, options.valve_heads, dropout=options.attention_dropout, batch_first=True
            )

    def begin_kept(self, n_episodes: int) -> CoreMemory:
        """Return the memory tokens (B, M, W), cached inputs of layers (B, L, C, W), how many those are."""
        cached = self.anchor.new_zeros(n_episodes, len(self.layers), self.options.cached_tokens, self.width)
        n_cached = torch.zeros(n_episodes, dtype=torch.long, device=self.anchor.device)
        first = self.anchor.new_zeros(0, self.width) if self.first_memory is None else self.first_memory
        return first.expand(n_episodes, -1, -1), cached, n_cached

    def forward(self, tokens: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """See `Core`; in training, windows of which nothing but tokens is kept are read all at once."""
        keeps = self.options.memory_tokens or self.options.cached_tokens
        may = self.training and self.overlap and not keeps and tokens.shape[1] > self.segment
        if may and not bool(memory[1].any()):  # looked at last: a GPU would be waited for in acting, too
            return self._all_windows(tokens, memory)
        return super().forward(tokens, memory)

    def _all_windows(self, tokens: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        room, n_tokens, *kept = memory
        n_episodes, n_new = tokens.shape[:2]
        moves_by = self.segment - self.overlap
        n_missing = -(n_new - self.segment) % moves_by  # no token reads a later one
        padded = functional.pad(tokens, (0, 0, 0, n_missing))
        windows = padded.unfold(1, self.segment, moves_by).transpose(2, 3)  # (B, windows, S, W)
        read, _ = self.read_segment(windows.flatten(0, 1), self.begin_kept(n_episodes * windows.shape[1]))
        of_windows = read.reshape(*windows.shape)
        later = of_windows[:, 1:, self.overlap :].flatten(1, 2)
        answers = torch.cat([of_windows[:, 0], later], dim=1)[:, :n_new]
        n_left = self.overlap + (n_new - self.segment) % moves_by
        room = torch.cat([tokens[:, n_new - n_left :].to(room.dtype), room[:, n_left:]], dim=1)
        return answers, (room, torch.full_like(n_tokens, n_left), *kept)

    def read_segment(self, tokens: Tensor, kept: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """See `Segmented`."""
        memory, cached, n_cached = kept
        room = cached.shape[2]
        if self.training:  # what is absent in all rows costs nothing; otherwise shapes, and bits, are fixed
            cached = cached[:, :, room - int(n_cached.max()) :]
        stream = self.drop(torch.cat([memory, tokens, memory], dim=1))
        n_queries, n_keys = stream.shape[1], cached.shape[2] + stream.shape[1]
        allowed = self._allowed(n_queries, cached.shape[2], n_cached)
        apart = self.drop(sinusoids(distances_of(n_queries, n_keys, tokens.device), self.width))[None]
        inputs = []
        for index, layer in enumerate(self.layers):
            inputs.append(stream)
            stream = layer(stream, cached[:, index], apart, allowed, self.biases)
        answers = self.drop(stream)
        written = answers[:, stream.shape[1] - memory.shape[1] :]
        after = torch.cat([kept[1], torch.stack(inputs, dim=1).detach()], dim=2)
        return (
            answers[:, memory.shape[1] : memory.shape[1] + tokens.shape[1]],
            (
                self._retained(memory, written),
                after[:, :, after.shape[2] - room :],
                (n_cached + n_queries).clamp(max=room),
            ),
        )

    def _allowed(self, n_queries: int, n_room: int, n_cached: Tensor) -> Tensor:
        """Return (B, Q, K): what tokens read. Memory tokens read each other, and nothing cached."""
        device, n_memory = n_cached.device, self.options.memory_tokens
        own = causal(n_queries, n_queries, device)
        if n_memory:
            own[:n_memory, :n_memory] = True
            own[-n_memory:, -n_memory:] = True
        is_token = torch.zeros(n_queries, dtype=torch.bool, device=device)
        is_token[n_memory : n_queries - n_memory] = True
        is_there = torch.arange(n_room, device=device)[None] >= n_room - n_cached[:, None]
        past = is_token[None, :, None] & is_there[:, None, :]
        return torch.cat([past, own.expand(len(n_cached), -1, -1)], dim=2)

    def _retained(self, memory: Tensor, written: Tensor) -> Tensor:
        if self.valve is not None:
            written = functional.relu(written)
            written, _ = self.valve(memory, written, written, need_weights=False)
        return written if self.options.carries_gradient else written.detach()
