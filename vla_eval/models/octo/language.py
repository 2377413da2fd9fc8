"""Octo's instruction: a frozen T5 encoder, asked once per prompt. Knows nothing of images or actions."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any  # transformers is untyped

import torch
from torch import Tensor, nn

from vla_eval.errors import MissingInstructionError

MAX_PROMPTS = 4096  # kept; a data set has a handful


@dataclass(frozen=True, slots=True, kw_only=True)
class T5Sizes:
    """What a T5 encoder is made of; the defaults are those of t5-base.

    Source: https://huggingface.co/google-t5/t5-base/blob/a9723ea7f1b39c1eae772870f3b547bf6ef7e6c1/config.json
    """

    vocabulary: int = 32128
    width: int = 768
    key: int = 64
    heads: int = 12
    layers: int = 12
    mlp_width: int = 3072
    buckets: int = 32
    max_distance: int = 128


def make_text_encoder(sizes: T5Sizes) -> Any:
    """Return transformers' encoder with random weights, frozen and without dropout."""
    from transformers import T5Config, T5EncoderModel

    config = T5Config(
        vocab_size=sizes.vocabulary,
        d_model=sizes.width,
        d_kv=sizes.key,
        num_heads=sizes.heads,
        num_layers=sizes.layers,
        d_ff=sizes.mlp_width,
        relative_attention_num_buckets=sizes.buckets,
        relative_attention_max_distance=sizes.max_distance,
        feed_forward_proj="relu",
        layer_norm_epsilon=1e-6,
        dropout_rate=0.0,
    )
    return T5EncoderModel(config).eval().requires_grad_(False)


class PromptEmbeddings:
    """The embeddings of prompts, each computed once; they live as long as the encoder's weights stay."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, ...], Tensor] = {}

    @torch.no_grad()
    def __call__(self, encoder: nn.Module, tokens_BL: Tensor, mask_BL: Tensor) -> Tensor:
        """Return (B, L, width) of tokens, whose mask is True where they are not padding; no row is empty."""
        if not bool(mask_BL.any(dim=1).all()):
            raise MissingInstructionError(
                "an instruction has no tokens: it is empty. Give the task one in prompts/."
            )
        rows = [tuple(row) for row in (tokens_BL * mask_BL).tolist()]
        new = {row: index for index, row in enumerate(rows) if row not in self._known}
        if new:
            self._add(encoder, new, tokens_BL, mask_BL)
        return torch.stack([self._known[row] for row in rows]).to(tokens_BL.device)

    def clear(self) -> None:
        """Forget all: the encoder's weights have changed."""
        self._known.clear()

    def _add(
        self, encoder: Any, new: Mapping[tuple[int, ...], int], tokens_BL: Tensor, mask_BL: Tensor
    ) -> None:
        if len(self._known) + len(new) > MAX_PROMPTS:
            self._known.clear()
            raise MissingInstructionError(
                f"more than {MAX_PROMPTS} different instructions; their embeddings are kept, one each."
            )
        # One by one: what a prompt becomes must not depend on which others are beside it.
        for row, index in new.items():
            seen = encoder(input_ids=tokens_BL[index][None], attention_mask=mask_BL[index][None].long())
            self._known[row] = seen.last_hidden_state[0].detach()
