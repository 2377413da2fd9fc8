"""Processors of a policy that reads a prompt: instruction, tokens, normalised targets in, actions out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any  # lerobot is untyped

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    ComplementaryDataProcessorStep,
    DeviceProcessorStep,
    TokenizerProcessorStep,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from vla_eval.errors import MissingInstructionError
from vla_eval.models.shared.byte_tokenizer import BYTE_TOKENIZER, byte_tokenizer
from vla_eval.models.shared.normalization import Normalization
from vla_eval.models.shared.processor_steps import DecoderStep, EncoderStep

TASK = "task"


@dataclass
class InstructionStep(ComplementaryDataProcessorStep):  # type: ignore[misc]  # lerobot is untyped
    """Puts a policy's words around the instruction; a policy registers its own with a `prompt` method."""

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

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Change no field's shape."""
        return features


def language_processors(
    config: Any,
    prompt: InstructionStep,
    dataset_stats: dict[str, dict[str, Any]] | None,
    *,
    fields: Mapping[str, Normalization] | None = None,
) -> tuple[Any, Any]:
    """Return pre- and postprocessor.

    Args:
        config: of the policy, with `tokenizer_name`, `prompt_max_tokens` and `encoder_settings`.
        prompt: what makes the prompts.
        dataset_stats: field -> statistics; None: they come from a checkpoint.
        fields: how fields are normalised with foreign statistics; None: as the configuration says.
    """
    default = make_default_policy_processor_steps(config, None)
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
    statistics = {**settings, "fields": fields or settings["fields"], "stats": dataset_stats}
    processors: tuple[Any, Any] = make_policy_processor_pipelines(
        input_steps=[
            default.rename_observations,
            default.add_batch_dim,
            prompt,
            tokens,
            default.to_device,
            EncoderStep(**statistics),
        ],
        output_steps=[
            DecoderStep(**statistics),
            DeviceProcessorStep(device="cpu"),
        ],
    )
    return processors
