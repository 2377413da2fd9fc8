"""Which words are in the instruction: a word's row of learned vectors is a digest of its letters."""

import re
import zlib
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any  # a batch of lerobot's

import torch
from torch import Tensor, nn

from vla_eval.errors import MissingInstructionError
from vla_eval.models.shared.sentence_reading import SentenceReading
from vla_eval.models.shared.tokens_read import note

TASK_KEY = "task"  # of a batch: one sentence per episode
ROWS = 4096  # of the table; some fifty words of our tasks' sentences have one each, which a test checks
NUMBERS = 32  # of a word's vector
WORD = re.compile(r"\w+")


class SentenceEncoder(nn.Module):
    """The mean of learned vectors of a sentence's words, through a linear layer to so many outputs."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.words = nn.EmbeddingBag(ROWS, NUMBERS, mode="mean")
        self.said = nn.Linear(NUMBERS, outputs)

    def forward(self, sentences: Sequence[str]) -> Tensor:
        """Return (B, outputs) of B sentences; raise `MissingInstructionError` if one has no word."""
        rows = [word_rows(sentence) for sentence in sentences]
        for sentence, own in zip(sentences, rows, strict=True):
            kept = " ".join(sorted(WORD.findall(sentence.lower())))
            ids = tuple(sorted(own))
            note(SentenceReading(sentence=sentence, ids=ids, n_tokens=len(own), limit=None, kept=kept))
        device = self.words.weight.device
        words = torch.tensor([row for own in rows for row in own], device=device)
        begins = torch.tensor([0, *accumulate(len(own) for own in rows[:-1])], device=device)
        said: Tensor = self.said(self.words(words, begins))
        return said


def word_rows(sentence: str) -> list[int]:
    """Return the row of each word, in any case; raise `MissingInstructionError` if there is no word."""
    words = WORD.findall(sentence.lower())
    if not words:
        raise MissingInstructionError(
            f"the policy reads the instruction (sentence: words); expected one with a word in it, found "
            f"{sentence!r}."
        )
    return [zlib.crc32(word.encode()) % ROWS for word in words]


def said_at_each_step(
    encoder: SentenceEncoder | None, batch: Mapping[str, Any], n_steps: int
) -> Tensor | None:
    """Return (B, T, outputs) of the episodes' sentences, the same at each step; None without an encoder."""
    if encoder is None:
        return None
    sentences = batch.get(TASK_KEY)
    if isinstance(sentences, str):
        sentences = [sentences]
    if not sentences or not all(isinstance(sentence, str) for sentence in sentences):
        raise MissingInstructionError(
            f"the policy reads the instruction (sentence: words); expected a sentence per episode in the "
            f"batch's '{TASK_KEY}', found {sentences!r:.100}."
        )
    said: Tensor = encoder(sentences)
    return said[:, None].expand(-1, n_steps, -1)


def with_sentence(layers: nn.Sequential, inputs: Tensor, said: Tensor | None) -> Tensor:
    """Return what layers, a linear map first, make of inputs; what is said is added after the first."""
    if said is None:
        alone: Tensor = layers(inputs)
        return alone
    together: Tensor = layers[1:](layers[0](inputs) + said)
    return together
