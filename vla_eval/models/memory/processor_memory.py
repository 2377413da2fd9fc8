"""lerobot's processors of the positive control: its defaults, which leave all numbers as they are."""

from typing import Any  # lerobot is untyped

from lerobot.processor import make_default_pre_post_processors

from vla_eval.models.memory.configuration_memory import MikasaMemoryConfig


def make_mikasa_memory_pre_post_processors(
    config: MikasaMemoryConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[Any, Any]:
    """Return pre- and postprocessor; lerobot finds this function by its name."""
    processors: tuple[Any, Any] = make_default_pre_post_processors(
        config, dataset_stats, normalizer_device=config.device
    )
    return processors
