"""OpenVLA's prompt: its words, and the token that ends it.

Source of words and token: https://github.com/moojink/openvla-oft/blob/
213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/prismatic/extern/hf/modeling_prismatic.py#L960-L985 and
prismatic/vla/datasets/datasets.py#L44-L60.
"""

import torch
from torch import Tensor

from vla_eval.errors import MissingInstructionError, SpecMismatchError
from vla_eval.policies.openvla.network import Prompts
from vla_eval.policies.openvla.sizes import NetworkSizes

TEMPLATE = "In: What action should the robot take to {instruction}?\nOut:"
SPACE = "Ġ"  # how a byte-level tokenizer writes a space
BYTE_SIZES = {
    "pad_token": 0,
    "bos_token": 1,
    "stop_token": 2,
    # Bytes 33 to 126, 161 to 172 and 174 to 255 stand for themselves; the space is the 33rd of the others,
    # which follow from code point 256 on: 3 special tokens, 188 of the former, 32 of the latter before it.
    "empty_token": 223,
    "text_vocabulary": 520,
    "vocabulary": 520,
}
"""Token numbers that go with the tokenizer of bytes."""


def prompt_text(instruction: str) -> str:
    """Return the prompt of an instruction, which is written in lower case, as in the original.

    Raises:
        MissingInstructionError: there are no words.
    """
    words = instruction.strip().lower()
    if not words:
        raise MissingInstructionError("OpenVLA needs an instruction, found an empty one.")
    return TEMPLATE.format(instruction=words)


def finished(ids: Tensor, mask: Tensor, sizes: NetworkSizes) -> Prompts:
    """Return tokenised prompts (B, T), padded on the right, with the empty token at each one's end.

    Raises:
        SpecMismatchError: a prompt does not begin as the model's tokenizer begins it.
    """
    if not bool((ids[:, 0] == sizes.bos_token).all()):
        raise SpecMismatchError(
            f"OpenVLA's prompts begin with the token {sizes.bos_token}, found {ids[:, 0].tolist()}. The "
            f"tokenizer is not the model's, or it was told to add no special tokens."
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
