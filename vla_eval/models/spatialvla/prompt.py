"""SpatialVLA's prompt, after its images' tokens. Source: prompts of the golden files."""

import torch
from torch import Tensor

from vla_eval.errors import SpecMismatchError
from vla_eval.models.shared.prompts import Prompts, instruction_words
from vla_eval.models.spatialvla.sizes import NetworkSizes

END = "\n"


def prompt_text(instruction: str) -> str:
    """Return the prompt of an instruction."""
    return f"{instruction_words(instruction, model='SpatialVLA')}{END}"


def finished(ids: Tensor, mask: Tensor, sizes: NetworkSizes) -> Prompts:
    """Return prompts (B, T), padded on the right, with the beginning of text before each."""
    keep = mask.bool()
    last = ids.gather(1, (keep.sum(dim=1, keepdim=True) - 1).clamp(min=0))[:, 0]
    if not bool((last == sizes.newline_token).all()):
        raise SpecMismatchError(
            f"SpatialVLA's prompts end with the token {sizes.newline_token} (newline), found "
            f"{last.tolist()}. The tokenizer is not the model's: name the model's folder with `tokenizer`."
        )
    if bool((ids.masked_fill(~keep, sizes.pad_token) >= sizes.image_token).any()):
        raise SpecMismatchError(
            f"a prompt holds tokens from {sizes.image_token} on, which stand for images and actions. Leave "
            "such words out of the instruction, or name the model's own tokenizer."
        )
    has_begin = (ids[:, 0] == sizes.bos_token).all()
    if bool(has_begin):
        return Prompts(ids, keep)
    begin = torch.full_like(ids[:, :1], sizes.bos_token)
    return Prompts(torch.cat([begin, ids], dim=1), torch.cat([torch.ones_like(keep[:, :1]), keep], dim=1))
