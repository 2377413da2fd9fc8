"""What a policy needs of a core over time: tokens in, one answer per token out, and what is kept.

Every core answers a token from that token and those before it alone. It gives the same answers, up to
rounding, whether it is given the tokens of an episode at once or one after the other.

What cores and their layers are made from has the same name everywhere: `width` of tokens, `layers` one above
the other, `heads` of attention, `dropout` of the outputs of sublayers (and of tokens), `attention_dropout` of
attention's weights, `segment`: tokens of a segment, `options`: the other sizes.
"""

import abc

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
