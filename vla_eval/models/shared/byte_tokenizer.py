"""A tokenizer of bytes, made from nothing: for tiny models, which no published tokenizer fits."""

from collections.abc import Sequence
from typing import Any  # tokenizers and transformers are untyped here

BYTE_TOKENIZER = "bytes"
"""`tokenizer_name` of it in a recipe: one token per byte."""
BYTE_SPECIAL = ("<pad>", "<s>", "</s>")  # tokens 0, 1 and 2: padding, begin and end of a text


def byte_tokenizer() -> Any:
    """Return a tokenizer of one token per byte, which begins each text with `<s>`."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    pad, bos, eos = BYTE_SPECIAL
    symbols: Sequence[str] = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {symbol: index for index, symbol in enumerate([*BYTE_SPECIAL, *symbols])}
    tokenizer: Any = Tokenizer(models.BPE(vocab=vocabulary, merges=[]))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{bos} $A", special_tokens=[(bos, vocabulary[bos])]
    )
    make_fast: Any = PreTrainedTokenizerFast
    return make_fast(
        tokenizer_object=tokenizer, pad_token=pad, bos_token=bos, eos_token=eos, padding_side="right"
    )
