"""A feed-forward layer of several experts: each token is sent to one of them, and to one that takes all.

As ELMUR uses it at `top_k: 2` with one shared expert (offline_rl_baselines/ELMUR/layers/mixture_of_experts.py
of https://github.com/CognitiveAISystems/RATE, commit 8b80e4e), checked by golden values. There as here a
single chosen expert has the weight 1, so that neither the loss nor the source's balancing term teaches the
router anything: it stays the random partition of the tokens that it begins as. The term is left out.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional


class Experts(nn.Module):
    """See the module's text; one of `experts` is chosen, each of them `inner_width` wide."""

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
