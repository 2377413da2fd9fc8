"""lerobot's processors of the plain policies: its defaults, which leave all numbers as they are."""

from typing import Any  # lerobot is untyped

from lerobot.processor import make_default_pre_post_processors

from vla_eval.models.sequence.configuration_sequence import MikasaSequenceConfig


def make_mikasa_sequence_pre_post_processors(
    config: MikasaSequenceConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[Any, Any]:
    """Return pre- and postprocessor; lerobot finds this function by its name."""
    processors: tuple[Any, Any] = make_default_pre_post_processors(
        config, dataset_stats, normalizer_device=config.device
    )
    return processors
