"""OpenVLA's prompt: its words, and the token that ends it.

Source of words and token: https://github.com/moojink/openvla-oft/blob/
213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/prismatic/extern/hf/modeling_prismatic.py#L960-L985 and
prismatic/vla/datasets/datasets.py#L44-L60.
"""

import torch
from torch import Tensor

from vla_eval.errors import SpecMismatchError
from vla_eval.models.openvla.sizes import NetworkSizes
from vla_eval.models.shared.prompts import Prompts, instruction_words

TEMPLATE = "In: What action should the robot take to {instruction}?\nOut:"


def prompt_text(instruction: str) -> str:
    """Return the prompt of an instruction."""
    return TEMPLATE.format(instruction=instruction_words(instruction, model="OpenVLA"))


def finished(ids: Tensor, mask: Tensor, sizes: NetworkSizes) -> Prompts:
    """Return tokenised prompts (B, T), padded on the right, with the empty token at each one's end."""
    if not bool((ids[:, 0] == sizes.bos_token).all()):
        raise SpecMismatchError(
            f"OpenVLA's prompts begin with the token {sizes.bos_token}, found {ids[:, 0].tolist()}. The "
            f"tokenizer is not the model's, or adds no special tokens."
        )
    lengths = mask.sum(dim=1)
    last = ids.gather(1, (lengths - 1)[:, None])[:, 0]
    is_missing = last != sizes.empty_token
    wider = torch.cat([ids, torch.full_like(ids[:, :1], sizes.pad_token)], dim=1)
    places = torch.arange(wider.shape[1], device=ids.device)
    ends = (places == lengths[:, None]) & is_missing[:, None]
    return Prompts(
        ids=torch.where(ends, sizes.empty_token, wider), mask=places < (lengths + is_missing)[:, None]
    )
