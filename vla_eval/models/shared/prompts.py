"""Prompts of language models: tokens and mask, and the words of an instruction. Knows no tokenizer."""

from typing import NamedTuple

from torch import Tensor

from vla_eval.errors import MissingInstructionError


class Prompts(NamedTuple):
    """Prompts of B samples, without actions: ids (B, T), right-padded; the mask is False for padding."""

    ids: Tensor
    mask: Tensor


def instruction_words(instruction: str, *, model: str) -> str:
    """Return the instruction, which must not be empty, in lower case, as both originals have it."""
    words = instruction.strip().lower()
    if not words:
        raise MissingInstructionError(f"{model} needs an instruction, found an empty one.")
    return words
