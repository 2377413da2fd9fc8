"""What a policy needs of a core over time: tokens in, one answer per token out, and what is kept.

Every core answers a token from that token and those before it alone. It gives the same answers, up to
rounding, whether it is given the tokens of an episode at once or one after the other.

What cores and their layers are made from has the same name everywhere: `width` of tokens, `layers` one above
the other, `heads` of attention, `dropout` of the outputs of sublayers (and of tokens), `attention_dropout` of
attention's weights, `segment`: tokens of a segment, `options`: the other sizes.
"""

import abc

import torch
from torch import Tensor, nn

CoreMemory = tuple[Tensor, ...]
"""What is kept of B episodes, each tensor (B, …)."""


class Core(nn.Module, abc.ABC):
    """What a policy needs of a core."""

    @abc.abstractmethod
    def begin(self, n_episodes: int) -> CoreMemory:
        """Return the memory before the first step."""

    @abc.abstractmethod
    def forward(self, tokens: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """Return the answers (B, T, width) to tokens (B, T, width), and the memory after the last."""


class Segmented(Core):
    """Reads an episode in segments; each begins with the last `overlap` tokens of the one before.

    Every pass computes a whole segment, of which what has not been seen yet is ignored: so an answer is
    the same whether tokens come one by one or all at once, and the same bits whatever the other rows are.
    """

    anchor: Tensor

    def __init__(self, *, width: int, segment: int, overlap: int = 0) -> None:
        super().__init__()
        self.width, self.segment, self.overlap = width, segment, overlap
        self.register_buffer("anchor", torch.zeros(1), persistent=False)  # says which device this is

    @abc.abstractmethod
    def begin_kept(self, n_episodes: int) -> CoreMemory:
        """Return what is kept before the first segment, each tensor (B, …)."""

    @abc.abstractmethod
    def read_segment(self, tokens: Tensor, kept: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """Return the answers to a segment (B, S, W), each from no later token, and what a full one leaves."""

    def begin(self, n_episodes: int) -> CoreMemory:
        """Return room for the tokens of a segment, how many there are, (B,), and what is kept."""
        room = self.anchor.new_zeros(n_episodes, self.segment, self.width)
        n_tokens = torch.zeros(n_episodes, dtype=torch.long, device=self.anchor.device)
        return (room, n_tokens, *self.begin_kept(n_episodes))

    def forward(self, tokens: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        """See `Core`."""
        answers: list[Tensor] = []
        n_read = 0
        while n_read < tokens.shape[1]:
            # How many of the tokens left fit into the segments of all rows at once.
            fewest, most = int(memory[1].min()), int(memory[1].max())
            n_next = min(self.segment - most, tokens.shape[1] - n_read) if fewest == most else 1
            answer, memory = self._piece(tokens[:, n_read : n_read + n_next], memory)
            answers.append(answer)
            n_read += n_next
        return torch.cat(answers, dim=1), memory

    def _piece(self, new: Tensor, memory: CoreMemory) -> tuple[Tensor, CoreMemory]:
        room, n_tokens, *kept = memory
        places = n_tokens[:, None] + torch.arange(new.shape[1], device=new.device)
        index = places[..., None].expand_as(new)
        room = room.scatter(1, index, new.to(room.dtype))
        answers, after = self.read_segment(room, tuple(kept))
        n_tokens = n_tokens + new.shape[1]
        is_full = n_tokens == self.segment
        begun = torch.zeros_like(room)
        begun[:, : self.overlap] = room[:, self.segment - self.overlap :]
        chosen = tuple(_where(is_full, now, before) for now, before in zip(after, kept, strict=True))
        n_tokens = torch.where(is_full, self.overlap, n_tokens)
        return answers.gather(1, index), (_where(is_full, begun, room), n_tokens, *chosen)


def _where(rows: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    """Return rows of `yes` where (B,) is true, and of `no` elsewhere, in the type of `no`."""
    return torch.where(rows.reshape(-1, *[1] * (yes.ndim - 1)), yes.to(no.dtype), no)
