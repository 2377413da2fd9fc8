"""lerobot's processors of OpenVLA: prompt, tokens and normalised targets in, actions out."""

from dataclasses import dataclass
from typing import Any  # lerobot is untyped

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    ComplementaryDataProcessorStep,
    DeviceProcessorStep,
    ProcessorStepRegistry,
    TokenizerProcessorStep,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from vla_eval.errors import MissingInstructionError
from vla_eval.policies.openvla.configuration_openvla import BYTE_TOKENIZER, MikasaOpenVLAConfig
from vla_eval.policies.openvla.prompt import byte_tokenizer, prompt_text
from vla_eval.policies.steps.processor_steps import DecoderStep, EncoderStep

PROMPT_STEP = "mikasa_openvla_prompt"
TASK = "task"


@dataclass
@ProcessorStepRegistry.register(name=PROMPT_STEP)
class PromptStep(ComplementaryDataProcessorStep):  # type: ignore[misc]  # lerobot is untyped
    """Puts OpenVLA's words around the instruction."""

    def complementary_data(self, complementary_data: dict[str, Any]) -> dict[str, Any]:
        """Return the data with the prompts in the place of the instructions."""
        tasks = complementary_data.get(TASK)
        if tasks is None:
            raise MissingInstructionError("OpenVLA needs an instruction, found none in the batch.")
        texts = [tasks] if isinstance(tasks, str) else list(tasks)
        return {**complementary_data, TASK: [prompt_text(str(text)) for text in texts]}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Change no field's shape."""
        return features


def make_mikasa_openvla_pre_post_processors(
    config: MikasaOpenVLAConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[Any, Any]:
    """Return pre- and postprocessor; lerobot finds this function by its name."""
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
    statistics = {**config.encoder_settings, "stats": dataset_stats}
    processors: tuple[Any, Any] = make_policy_processor_pipelines(
        input_steps=[
            default.rename_observations,
            default.add_batch_dim,
            PromptStep(),
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
