"""SpatialVLA's prompt: the instruction in small letters and a newline, with the text's beginning before it.

The pictures' tokens stand before the text; `network` puts them there. Source: prompts of the golden files.
"""

import torch
from torch import Tensor

from vla_eval.errors import MissingInstructionError, SpecMismatchError
from vla_eval.policies.spatialvla.network import Prompts
from vla_eval.policies.spatialvla.sizes import NetworkSizes

END = "\n"
BYTE_SIZES = {
    "pad_token": 0,
    "bos_token": 1,
    "stop_token": 2,
    # 3 special tokens, 188 bytes that stand for themselves (33 to 126, 161 to 172, 174 to 255), then the
    # others in order, of which the newline, number 10, is the 11th.
    "newline_token": 201,
    "image_token": 259,
    "first_action_token": 260,
}
"""Token numbers that go with the tokenizer of bytes."""


def prompt_text(instruction: str) -> str:
    """Return the prompt of an instruction.

    Raises:
        MissingInstructionError: there are no words.
    """
    words = instruction.strip().lower()
    if not words:
        raise MissingInstructionError("SpatialVLA needs an instruction, found an empty one.")
    return f"{words}{END}"


def finished(ids: Tensor, mask: Tensor, sizes: NetworkSizes) -> Prompts:
    """Return tokenised prompts (B, T), padded on the right, with the beginning of text before each.

    Some tokenizers put that token there by themselves, others do not; both come to the same.

    Raises:
        SpecMismatchError: a prompt does not end with the model's newline, or holds tokens that tell pictures
            or actions: the tokenizer is not the model's.
    """
    keep = mask.bool()
    last = ids.gather(1, (keep.sum(dim=1, keepdim=True) - 1).clamp(min=0))[:, 0]
    if not bool((last == sizes.newline_token).all()):
        raise SpecMismatchError(
            f"SpatialVLA's prompts end with the token {sizes.newline_token} (newline), found "
            f"{last.tolist()}. The tokenizer is not the model's: name the model's folder with `tokenizer`."
        )
    if bool((ids.masked_fill(~keep, sizes.pad_token) >= sizes.image_token).any()):
        raise SpecMismatchError(
            f"a prompt holds tokens from {sizes.image_token} on, which tell pictures and actions. Leave such "
            "words out of the instruction, or name the model's own tokenizer."
        )
    has_begin = (ids[:, 0] == sizes.bos_token).all()
    if bool(has_begin):
        return Prompts(ids, keep)
    begin = torch.full_like(ids[:, :1], sizes.bos_token)
    return Prompts(torch.cat([begin, ids], dim=1), torch.cat([torch.ones_like(keep[:, :1]), keep], dim=1))
