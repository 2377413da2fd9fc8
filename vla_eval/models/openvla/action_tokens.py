"""Actions as tokens: 255 bins over [-1, 1], which are the last tokens of the vocabulary, counted from behind.

Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
prismatic/vla/action_tokenizer.py#L13-L72 and, for unknown tokens, prismatic/extern/hf/
modeling_prismatic.py#L877-L916.
"""

import torch
from torch import Tensor

from vla_eval.models.openvla.sizes import N_BINS


def to_tokens(actions: Tensor, text_vocabulary: int) -> Tensor:
    """Return the tokens (…) int64 of normalised actions (…); what is beyond [-1, 1] takes the outermost.

    `text_vocabulary`: tokens of the tokenizer: the first bin is the last of them.
    """
    edges = torch.linspace(-1, 1, N_BINS, dtype=torch.float64, device=actions.device)
    return text_vocabulary - torch.bucketize(actions.double().clamp(-1, 1), edges, right=True)


def from_tokens(tokens: Tensor, text_vocabulary: int) -> Tensor:
    """Return the normalised actions float32, the middles of the bins; a token that is none is the nearest."""
    edges = torch.linspace(-1, 1, N_BINS, dtype=torch.float64, device=tokens.device)
    middles = (edges[:-1] + edges[1:]) / 2
    # The value 1 alone is in a bin of its own, number 256; it shares the last middle.
    bins = (text_vocabulary - tokens - 1).clamp(0, N_BINS - 2)
    return middles[bins].float()
