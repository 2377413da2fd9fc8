"""lerobot's processors of SpatialVLA: prompt, tokens and normalised targets in, actions out."""

from dataclasses import dataclass
from typing import Any  # lerobot is untyped

from lerobot.processor import ProcessorStepRegistry

from vla_eval.models.shared.language_processors import InstructionStep, instruction_words, language_processors
from vla_eval.models.spatialvla.configuration_spatialvla import MikasaSpatialVLAConfig

PROMPT_STEP = "mikasa_spatialvla_prompt"


def prompt_text(instruction: str) -> str:
    """Return the prompt of an instruction, as in the golden files."""
    return f"{instruction_words(instruction, model='SpatialVLA')}\n"


@dataclass
@ProcessorStepRegistry.register(name=PROMPT_STEP)
class SpatialVLAPromptStep(InstructionStep):
    """Makes SpatialVLA's prompt of the instruction."""

    def prompt(self, instruction: str) -> str:
        """Return the prompt."""
        return prompt_text(instruction)


def make_mikasa_spatialvla_pre_post_processors(
    config: MikasaSpatialVLAConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[Any, Any]:
    """Return pre- and postprocessor; lerobot finds this function by its name."""
    return language_processors(config, SpatialVLAPromptStep(), dataset_stats)
