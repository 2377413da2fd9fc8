"""The first actions of a chunk that are already decided. Knows only torch."""

from typing import NamedTuple

import torch
from torch import Tensor


class Prefix(NamedTuple):
    """The first rows of chunks that are already decided."""

    actions: Tensor  # (…, chunk, action); what is not of the prefix has no meaning
    mask: Tensor  # (…, chunk) bool, True for rows of the prefix

    def put_into(self, actions: Tensor) -> Tensor:
        """Return actions (…, chunk, action) with the prefix in their place."""
        return torch.where(self.mask[..., None], self.actions, actions)


def drawn_lengths(like: Tensor, most_steps: int) -> Tensor:
    """Return how many rows are decided, 0 to `most_steps`, drawn for each chunk (…, chunk, action).

    Source: Black et al. 2025 (arXiv:2512.05964), section 3: the delay is simulated in training.
    """
    return torch.randint(0, most_steps + 1, like.shape[:-2], device=like.device)


def prefix_of(actions: Tensor, lengths: Tensor) -> Prefix:
    """Return the first `lengths` (…) rows of chunks (…, chunk, action)."""
    return Prefix(actions, torch.arange(actions.shape[-2], device=actions.device) < lengths[..., None])
