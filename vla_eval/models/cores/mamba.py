"""Decision Mamba: Mamba's blocks, whose state is the memory, between layers for each token.

Ota 2024, "Decision Mamba" (arXiv:2403.19925), as in offline_rl_baselines/DMamba.py of
https://github.com/CognitiveAISystems/RATE (commit 8b80e4e, `token_mixer: mamba`). The blocks are those of the
library mambapy, which is plain torch; the source's mamba-ssm needs CUDA to be installed.
"""

from typing import Any  # mambapy is untyped

import torch
from torch import Tensor, nn

from vla_eval.models.cores.core import Core, CoreMemory
from vla_eval.models.cores.sizes import MambaOptions


class MambaLayer(nn.Module):
    """A block of Mamba and two layers for each token, each added to the stream."""

    def __init__(self, *, width: int, dropout: float, options: MambaOptions) -> None:
        super().__init__()
        from mambapy.mamba import MambaBlock, MambaConfig

        sizes = MambaConfig(
            d_model=width,
            n_layers=1,
            d_state=options.state,
            d_conv=options.convolved,
            expand_factor=options.expand,
        )
        self.norm, self.block = nn.LayerNorm(width), MambaBlock(sizes)
        self.feed = nn.Sequential(
            nn.LayerNorm(width),
            nn.Linear(width, 4 * width),
            nn.GELU(),
            nn.Linear(4 * width, width),
            nn.Dropout(dropout),
        )

    def forward(self, tokens: Tensor) -> Tensor:
        """Return (B, T, W) of an episode's first tokens (B, T, W)."""
        stream = tokens + self.block(self.norm(tokens))
        returned: Tensor = stream + self.feed(stream)
        return returned

    def step(self, token: Tensor, cache: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Return (B, W) of the next token (B, W), and what is kept after it."""
        mixed, cache = self.block.step(self.norm(token), cache)
        stream = token + mixed
        return stream + self.feed(stream), cache


class DecisionMamba(Core):
    """See the module's text."""

    def __init__(self, *, width: int, layers: int, dropout: float, options: MambaOptions) -> None:
        super().__init__()
        self.options, self.width, self.drop = options, width, nn.Dropout(dropout)
        self.layers = nn.ModuleList(
            MambaLayer(width=width, dropout=dropout, options=options) for _ in range(layers)
        )
        self.norm = nn.LayerNorm(width)

    def begin(self, n_episodes: int) -> CoreMemory:
        """Return states (B, L, units, state), inputs of convolutions (B, L, units, …), tokens so far (B,)."""
        like, n_layers = self.norm.weight, len(self.layers)
        units = self.options.expand * self.width
        states = like.new_zeros(n_episodes, n_layers, units, self.options.state)
        inputs = like.new_zeros(n_episodes, n_layers, units, self.options.convolved - 1)
        return states, inputs, torch.zeros(n_episodes, dtype=torch.long, device=like.device)

    def forward(self, tokens: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """See `Core`; in training from an episode's beginning on, whose memory is not asked for then."""
        if self.training:
            if bool(memory[2].any()):
                raise ValueError("Decision Mamba is trained on episodes from their beginning.")
            stream = self.drop(tokens)
            for layer in self.layers:
                stream = layer(stream)
            return self.norm(stream), memory
        states, inputs, n_tokens = memory
        answers = []
        for token in tokens.unbind(dim=1):
            caches: list[Any] = []
            for index, layer in enumerate(self.layers):
                assert isinstance(layer, MambaLayer)
                token, cache = layer.step(token, (states[:, index], inputs[:, index]))
                caches.append(cache)
            states, inputs = (torch.stack(parts, dim=1) for parts in zip(*caches, strict=True))
            answers.append(self.norm(token))
        return torch.stack(answers, dim=1), (states, inputs, n_tokens + tokens.shape[1])
