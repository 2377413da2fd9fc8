"""lerobot's configuration of the toy."""

from dataclasses import dataclass
from typing import Any

from lerobot.configs import PreTrainedConfig

from vla_eval.models.shared.ported_config import PortedConfig
from vla_eval.models.shared.stages import HEAD, Stage, Stages


@PreTrainedConfig.register_subclass("mikasa_toy")
@dataclass
class MikasaToyConfig(PortedConfig):
    """A linear map from the state to a chunk."""

    def validate_features(self) -> None: ...

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.chunk_size))

    def get_scheduler_preset(self) -> None:
        return None


def network_stages(config: Any) -> Stages:
    return (Stage("", 1, HEAD),)
