"""Processors of a policy that reads a prompt: instruction, tokens, normalised targets in, actions out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any  # lerobot is untyped

from lerobot.processor import (
    ComplementaryDataProcessorStep,
    DeviceProcessorStep,
    IdentityProcessorStep,
    TokenizerProcessorStep,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from vla_eval.errors import MissingInstructionError
from vla_eval.models.shared.normalization import Normalization
from vla_eval.models.shared.processor_steps import DecoderStep, EncoderStep

TASK = "task"
BYTE_TOKENIZER = "bytes"
"""`tokenizer_name` of it in a recipe: one token per byte."""
BYTE_SPECIAL = ("<pad>", "<s>", "</s>")  # tokens 0, 1 and 2: padding, begin and end of a text


def instruction_words(instruction: str, *, model: str) -> str:
    """Return the instruction, which must not be empty, in lower case, as both originals have it."""
    words = instruction.strip().lower()
    if not words:
        raise MissingInstructionError(f"{model} needs an instruction, found an empty one.")
    return words


@dataclass
class InstructionStep(ComplementaryDataProcessorStep):  # type: ignore[misc]  # lerobot is untyped
    """Puts a policy's words around the instruction; a policy registers its own with a `prompt` method."""

    transform_features = IdentityProcessorStep.transform_features

    def prompt(self, instruction: str) -> str:
        """Return the prompt of one instruction."""
        raise NotImplementedError

    def complementary_data(self, complementary_data: dict[str, Any]) -> dict[str, Any]:
        """Return the data with the prompts in the place of the instructions."""
        tasks = complementary_data.get(TASK)
        if tasks is None:
            raise MissingInstructionError(
                f"{type(self).__name__} needs an instruction, found none in the batch."
            )
        texts = [tasks] if isinstance(tasks, str) else list(tasks)
        return {**complementary_data, TASK: [self.prompt(str(text)) for text in texts]}


def language_processors(
    config: Any,
    prompt: InstructionStep,
    dataset_stats: dict[str, dict[str, Any]] | None,
    *,
    fields: Mapping[str, Normalization] | None = None,
) -> tuple[Any, Any]:
    """Return pre- and postprocessor with a step for prompts; `fields`: normalised by foreign statistics."""
    named = config.tokenizer_name != BYTE_TOKENIZER
    tokenizer = {"tokenizer_name": config.tokenizer_name} if named else {"tokenizer": byte_tokenizer()}
    tokens = TokenizerProcessorStep(
        **tokenizer,
        max_length=config.prompt_max_tokens,
        padding="longest",
        padding_side="right",
        truncation=False,
    )
    settings = config.encoder_settings
    settings = {**settings, "fields": fields or settings["fields"], "stats": dataset_stats}
    return encoded_processors(config, [prompt, tokens], settings)


def encoded_processors(config: Any, words: Sequence[Any], settings: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return pre- and postprocessor; `words`: steps of the instruction, `settings`: of our own."""
    default = make_default_policy_processor_steps(config, None)
    processors: tuple[Any, Any] = make_policy_processor_pipelines(
        input_steps=[
            default.rename_observations,
            default.add_batch_dim,
            *words,
            default.to_device,
            EncoderStep(**settings),
        ],
        output_steps=[DecoderStep(**settings), DeviceProcessorStep(device="cpu")],
    )
    return processors


def byte_tokenizer() -> Any:
    """Return a tokenizer of one token per byte, which begins each text with `<s>`: for tiny models."""
    from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    pad, bos, eos = BYTE_SPECIAL
    symbols: list[str] = sorted(pre_tokenizers.ByteLevel.alphabet())
    vocabulary = {symbol: index for index, symbol in enumerate([*BYTE_SPECIAL, *symbols])}
    tokenizer: Any = Tokenizer(models.BPE(vocab=vocabulary, merges=[]))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{bos} $A", special_tokens=[(bos, vocabulary[bos])]
    )
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token=pad, bos_token=bos, eos_token=eos, padding_side="right"
    )
