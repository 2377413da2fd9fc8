"""lerobot's processors of Octo: tokens of the instruction, actions in units of their deviation."""

from typing import Any  # lerobot and transformers are untyped

from lerobot.processor import TokenizerProcessorStep

from vla_eval.errors import CheckpointError
from vla_eval.models.octo.configuration_octo import BYTES_TOKENIZER, MikasaOctoConfig
from vla_eval.models.shared.language_processors import encoded_processors


def make_mikasa_octo_pre_post_processors(
    config: MikasaOctoConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[Any, Any]:
    """Return pre- and postprocessor, which need statistics; lerobot finds this function by its name."""
    if not dataset_stats:
        raise CheckpointError(
            "Octo's actions are normalised by a dataset's statistics, and none are given. Load a "
            "checkpoint's processors, or fine-tune on a dataset."
        )
    named = config.tokenizer_name != BYTES_TOKENIZER
    tokenizer = {"tokenizer_name": config.tokenizer_name} if named else {"tokenizer": _bytes_tokenizer()}
    # A lambda where `finetune.tokenizer` names a folder; lerobot's class otherwise.
    tokens = TokenizerProcessorStep(**tokenizer, max_length=config.language_tokens, padding="max_length")
    return encoded_processors(config, [tokens], {**config.encoder_settings, "stats": dataset_stats})


def _bytes_tokenizer() -> Any:
    from transformers import ByT5Tokenizer

    return ByT5Tokenizer(extra_ids=0)
