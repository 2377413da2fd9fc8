"""lerobot's processors of OpenVLA: prompt, tokens and normalised targets in, actions out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any  # lerobot is untyped

from lerobot.processor import ProcessorStepRegistry

from vla_eval.models.openvla.configuration_openvla import MikasaOpenVLAConfig
from vla_eval.models.shared.language_processors import InstructionStep, instruction_words, language_processors
from vla_eval.models.shared.normalization import Normalization

PROMPT_STEP = "mikasa_openvla_prompt"
# Source: https://github.com/moojink/openvla-oft/blob/213c5ff8d6e9673885d7e4dd6f2ce73b5d8a45db/
# prismatic/extern/hf/modeling_prismatic.py#L960-L985
TEMPLATE = "In: What action should the robot take to {instruction}?\nOut:"


def prompt_text(instruction: str) -> str:
    """Return the prompt of an instruction."""
    return TEMPLATE.format(instruction=instruction_words(instruction, model="OpenVLA"))


@dataclass
@ProcessorStepRegistry.register(name=PROMPT_STEP)
class OpenVLAPromptStep(InstructionStep):
    """Puts OpenVLA's words around the instruction."""

    def prompt(self, instruction: str) -> str:
        """Return the prompt."""
        return prompt_text(instruction)


def make_mikasa_openvla_pre_post_processors(
    config: MikasaOpenVLAConfig,
    dataset_stats: dict[str, dict[str, Any]] | None = None,
    *,
    fields: Mapping[str, Normalization] | None = None,
) -> tuple[Any, Any]:
    """Return pre- and postprocessor, see `language_processors`; lerobot finds this function by its name."""
    return language_processors(config, OpenVLAPromptStep(), dataset_stats, fields=fields)
