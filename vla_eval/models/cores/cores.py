"""The cores by name, and the plain ones: no memory, a recurrent state, a transformer over all frames."""

import math
from collections.abc import Mapping
from typing import Any  # values of a recipe

import torch
from torch import Tensor, nn

from vla_eval.models.cores.core import Core, CoreMemory
from vla_eval.models.cores.elmur import Elmur
from vla_eval.models.cores.mamba import DecisionMamba
from vla_eval.models.cores.sizes import (
    ElmurOptions,
    MambaOptions,
    RecurrentOptions,
    TransformerXLOptions,
    options_of,
)
from vla_eval.models.cores.transformer_xl import TransformerXL


class PerStep(Core):
    """No memory: two layers for each step, the same for all."""

    def __init__(self, *, width: int, layers: int, dropout: float) -> None:
        super().__init__()
        blocks: list[nn.Module] = []
        for _ in range(layers):
            blocks.extend([nn.Linear(width, width), nn.GELU(), nn.Dropout(dropout)])
        self.blocks = nn.Sequential(*blocks)

    def begin(self, n_episodes: int) -> CoreMemory:
        """Return nothing."""
        return ()

    def forward(self, tokens: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """See `Core`."""
        return self.blocks(tokens), ()


class Recurrent(Core):
    """torch's GRU or LSTM (`kind`), whose state is the memory; dropout is between its layers."""

    def __init__(
        self,
        kind: type[nn.GRU | nn.LSTM],
        *,
        width: int,
        layers: int,
        dropout: float,
        options: RecurrentOptions,
    ) -> None:
        super().__init__()
        self.cells = kind(width, width, layers, batch_first=True, dropout=dropout if layers > 1 else 0.0)
        with torch.no_grad():
            for layer in range(layers):
                # The gate that keeps the state is the second one of both, of three and of four.
                getattr(self.cells, f"bias_ih_l{layer}")[width : 2 * width] += options.keep_bias
        self.before = nn.LayerNorm(width) if options.answers_before else None

    def begin(self, n_episodes: int) -> CoreMemory:
        """Return states of zeros, (B, layers, width)."""
        cells = self.cells
        zeros = next(cells.parameters()).new_zeros(n_episodes, cells.num_layers, cells.hidden_size)
        return (zeros,) if isinstance(cells, nn.GRU) else (zeros, zeros.clone())

    def forward(self, tokens: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """See `Core`."""
        states = tuple(state.transpose(0, 1).contiguous() for state in memory)
        if isinstance(self.cells, nn.GRU):
            answers, last = self.cells(tokens, states[0])
            after: CoreMemory = (last.transpose(0, 1),)
        else:
            answers, (hidden, cell) = self.cells(tokens, states)
            after = (hidden.transpose(0, 1), cell.transpose(0, 1))
        if self.before is not None:
            answers = self.before(torch.cat([memory[0][:, -1:], answers[:, :-1]], dim=1))
        return answers, after


class CausalTransformer(Core):
    """torch's transformer layers, normalised before each part, over all steps so far.

    The memory is the tokens that were read, not what the layers made of them: reading all of them again at
    each step costs little compared with the images, and needs no code of ours in the layers. A layer sees the
    last `context_steps` steps of the one below, so that the memory is so much longer where there are more.
    """

    frequencies: Tensor

    def __init__(self, *, width: int, layers: int, heads: int, context_steps: int, dropout: float) -> None:
        super().__init__()
        self.heads, self.context_steps = heads, context_steps
        self.n_kept = max(1, layers * (context_steps - 1))
        layer = nn.TransformerEncoderLayer(
            width, heads, 4 * width, dropout, activation="gelu", batch_first=True, norm_first=True
        )
        self.blocks = nn.TransformerEncoder(layer, layers, nn.LayerNorm(width), enable_nested_tensor=False)
        # Sinusoidal positions: Vaswani et al. 2017, "Attention Is All You Need", section 3.5.
        scale = math.log(10_000) / (width // 2)
        self.register_buffer("frequencies", (-scale * torch.arange(width // 2)).exp(), persistent=False)

    def begin(self, n_episodes: int) -> CoreMemory:
        """Return room for the tokens (B, steps, width), and how many steps there were, (B,)."""
        like = self.frequencies
        tokens = like.new_zeros(n_episodes, self.n_kept, 2 * len(like))
        return tokens, torch.zeros(n_episodes, dtype=torch.long, device=like.device)

    def forward(self, tokens: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """See `Core`."""
        kept, n_before = memory
        n_kept, n_new = self.n_kept, tokens.shape[1]
        # Kept tokens stand at the right end of their room, so that the new ones follow.
        all_tokens = torch.cat([kept, tokens], dim=1)
        place = torch.arange(n_kept + n_new, device=tokens.device) - n_kept  # 0: the first new step
        step = (n_before[:, None] + place).clamp(min=0)
        # In training and alone, no step is read that is absent in all rows. Beside other episodes the length
        # is fixed: one that depends on them would choose other kernels, and other bits.
        trims = self.training or len(kept) == 1
        first = int((n_kept - n_before).clamp(min=0).min()) if trims else 0
        angles = step[:, first:, None] * self.frequencies
        read = all_tokens[:, first:] + torch.cat([angles.sin(), angles.cos()], dim=-1)
        distance = place[first:, None] - place[None, first:]
        hidden = (distance < 0) | (distance >= self.context_steps)
        absent = (place[first:] < -n_before[:, None])[:, None, :]
        # A step that is absent reads itself: a row without any would be no number.
        itself = torch.eye(len(distance), dtype=torch.bool, device=tokens.device)
        blocked = (hidden | absent) & ~itself
        answers = self.blocks(read, mask=blocked.repeat_interleave(self.heads, dim=0))[:, -n_new:]
        return answers, (all_tokens[:, -n_kept:], n_before + n_new)


def make_core(
    name: str,
    *,
    width: int,
    layers: int,
    heads: int,
    context_steps: int,
    dropout: float,
    tokens_per_step: int = 1,
    given: Mapping[str, Any] | None = None,
) -> Core:
    """Return the core of that name in `CORES`, with `given` options; see `core` for the sizes."""
    options, n_tokens = options_of(name, given or {}), context_steps * tokens_per_step
    stack: dict[str, Any] = {"width": width, "layers": layers, "dropout": dropout}
    if isinstance(options, TransformerXLOptions):
        # A window that moves on by a step shares all others with the one before.
        overlap = n_tokens - tokens_per_step if name == "decision_transformer" else 0
        return TransformerXL(**stack, heads=heads, segment=n_tokens, overlap=overlap, options=options)
    if isinstance(options, ElmurOptions):
        return Elmur(**stack, heads=heads, segment=n_tokens, options=options)
    if isinstance(options, MambaOptions):
        return DecisionMamba(**stack, options=options)
    if isinstance(options, RecurrentOptions):
        return Recurrent({"gru": nn.GRU, "lstm": nn.LSTM}[name], **stack, options=options)
    if name == "mlp":
        return PerStep(**stack)
    return CausalTransformer(**stack, heads=heads, context_steps=n_tokens)
