"""lerobot's processors of policies that learn from rewards: its defaults, which change nothing."""

from typing import Any  # lerobot is untyped

from lerobot.processor import make_default_pre_post_processors

from vla_eval.models.offline_rl.configuration_offline_rl import MikasaOfflineRLConfig


def make_mikasa_offline_rl_pre_post_processors(
    config: MikasaOfflineRLConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[Any, Any]:
    """Return pre- and postprocessor; lerobot finds this function by its name."""
    processors: tuple[Any, Any] = make_default_pre_post_processors(
        config, dataset_stats, normalizer_device=config.device
    )
    return processors
