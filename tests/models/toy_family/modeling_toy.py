"""The toy as a LeRobot policy."""

from typing import Any

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor, nn
from toy_family.configuration_toy import MikasaToyConfig

from vla_eval.features import ACTION_KEY, STATE_KEY


class MikasaToyPolicy(PreTrainedPolicy):
    config_class = MikasaToyConfig
    name = "mikasa_toy"

    def __init__(self, config: MikasaToyConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.shape = (config.chunk_size, config.action_feature.shape[0])
        self.head = nn.Linear(config.robot_state_feature.shape[0], self.shape[0] * self.shape[1])

    def get_optim_params(self) -> Any:
        return self.parameters()

    def reset(self) -> None: ...

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        loss = (self._chunk(batch) - batch[ACTION_KEY]).square().mean()
        return loss, {}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        return self._chunk(batch).clamp(-1, 1)

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        return self.predict_action_chunk(batch)[:, 0]

    def _chunk(self, batch: dict[str, Tensor]) -> Tensor:
        return self.head(batch[STATE_KEY]).unflatten(-1, self.shape)
