"""Recurrent memory tokens: what is carried from one pass of a language model to a later one.

They stand at the end of the prefix, in a block of attention of their own: they read all of the prefix, and
the action expert reads them; images and language do not. What the last layer makes of them is written into
the memory through a gate.

Source: Recurrent Memory Transformer (Bulatov et al. 2022, https://arxiv.org/abs/2207.06881), section 3. The
gate, which lets a token stay as it is over a delay, is ours, in the form of a GRU's (Cho et al. 2014).
"""

from typing import Any, NamedTuple  # lerobot is untyped

import torch
from torch import Tensor, nn

KEPT_AT_FIRST = 1.0  # bias of the gate: 0.73 of a token is kept by a writing before any training


class TokenMemory(NamedTuple):
    """What B episodes remember."""

    n_shown: Tensor  # (B,) frames so far
    read: Tensor  # (B, tokens, width) as an inference at the newest frame reads them: written before it
    written: Tensor  # (B, tokens, width) as later frames read them


class MemoryTokens(nn.Module):
    """The tokens, of the language model's width, before the first frame, and how they are written."""

    def __init__(self, n_tokens: int, width: int) -> None:
        super().__init__()
        self.initial = nn.Parameter(torch.randn(n_tokens, width))
        self.norm = nn.LayerNorm(width)
        self.gate = nn.Linear(width, width)
        self.value = nn.Linear(width, width)
        nn.init.constant_(self.gate.bias, KEPT_AT_FIRST)

    def begin(self, n_episodes: int) -> Tensor:
        """Return the tokens (B, tokens, width) before the first frame."""
        return self.initial.expand(n_episodes, -1, -1)

    def forward(self, tokens: Tensor, outputs: Tensor) -> Tensor:
        """Return the tokens (B, tokens, width) after a pass that read them, from its last layer's outputs."""
        outputs = self.norm(outputs.to(tokens.dtype))
        kept = self.gate(outputs).sigmoid()
        after: Tensor = kept * tokens + (1 - kept) * self.value(outputs)
        return after


class TakesTokens:
    """Of lerobot's flow matching models: a prefix that ends with tokens, if there are any."""

    given: Tensor | None = None

    def embed_prefix(self, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Return embeddings (B, N, width), which of them are there (B, N), and where blocks begin (B, N)."""
        embedded, present, begins = super().embed_prefix(*args, **kwargs)  # type: ignore[misc]
        if self.given is None:
            return embedded, present, begins
        tokens = self.given.to(embedded.dtype)
        own_block = begins.new_zeros(tokens.shape[:2])
        own_block[:, 0] = 1
        return (
            torch.cat([embedded, tokens], dim=1),
            torch.cat([present, present.new_ones(tokens.shape[:2])], dim=1),
            torch.cat([begins, own_block], dim=1),
        )


class CatchesPrefix:
    """Of lerobot's pairs of language model and expert: keeps what the language model made of the prefix."""

    prefix: Tensor | None = None

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Return what lerobot's does."""
        outputs, cache = super().forward(*args, **kwargs)  # type: ignore[misc]
        if outputs[0] is not None:
            self.prefix = outputs[0]
        return outputs, cache


def extend(module: nn.Module, part: type) -> None:
    """Let a module of lerobot's, which is built already, have the methods of `part` before its own."""
    own = type(module)
    module.__class__ = type(own.__name__, (part, own), {"__module__": part.__module__})
