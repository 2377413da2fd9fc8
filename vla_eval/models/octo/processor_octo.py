"""lerobot's processors of Octo: tokens of the instruction, actions in units of their deviation."""

from typing import Any  # lerobot and transformers are untyped

from lerobot.processor import (
    DeviceProcessorStep,
    PolicyProcessorPipeline,
    TokenizerProcessorStep,
    make_default_policy_processor_steps,
    policy_action_to_transition,
    transition_to_policy_action,
)

from vla_eval.errors import CheckpointError
from vla_eval.models.octo.configuration_octo import BYTES_TOKENIZER, MikasaOctoConfig
from vla_eval.models.shared.processor_steps import DecoderStep, EncoderStep

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor", "policy_postprocessor"


def make_mikasa_octo_pre_post_processors(
    config: MikasaOctoConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[Any, Any]:
    """Return pre- and postprocessor; lerobot finds this function by its name.

    Raises:
        CheckpointError: there are no statistics that actions could be normalised by.
    """
    if not dataset_stats:
        raise CheckpointError(
            "Octo's actions are normalised by a dataset's statistics, and none are given. Load a "
            "checkpoint's processors, or fine-tune on a dataset."
        )
    shared: dict[str, Any] = {**config.encoder_settings, "stats": dataset_stats}
    steps = make_default_policy_processor_steps(config, dataset_stats)
    before: Any = PolicyProcessorPipeline(
        steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            _tokenizer_step(config),
            DeviceProcessorStep(device=config.device),
            EncoderStep(**shared),
        ],
        name=PREPROCESSOR,
    )
    after: Any = PolicyProcessorPipeline(
        steps=[DecoderStep(**shared), DeviceProcessorStep(device="cpu")],
        name=POSTPROCESSOR,
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    return before, after


def _tokenizer_step(config: MikasaOctoConfig) -> Any:
    settings: dict[str, Any] = {"max_length": config.language_tokens, "padding": "max_length"}
    # A lambda where `finetune.tokenizer` names a folder; lerobot's class otherwise.
    if config.tokenizer_name == BYTES_TOKENIZER:
        return TokenizerProcessorStep(tokenizer=_bytes_tokenizer(), **settings)
    return TokenizerProcessorStep(tokenizer_name=config.tokenizer_name, **settings)


def _bytes_tokenizer() -> Any:
    from transformers import ByT5Tokenizer

    make: Any = ByT5Tokenizer
    return make(extra_ids=0)
