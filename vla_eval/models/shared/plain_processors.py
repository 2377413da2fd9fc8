"""lerobot's default processors, which leave all numbers as they are: for policies that normalise nothing."""

from typing import Any  # lerobot is untyped

from lerobot.processor import make_default_pre_post_processors


def make_plain_processors(
    config: Any, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[Any, Any]:
    """Return pre- and postprocessor of a policy."""
    processors: tuple[Any, Any] = make_default_pre_post_processors(
        config, dataset_stats, normalizer_device=config.device
    )
    return processors
