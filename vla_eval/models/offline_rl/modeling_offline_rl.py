"""Policies from offline reinforcement learning as a LeRobot policy: single frames in, single actions out."""

import math
from typing import Any, ClassVar  # lerobot is untyped

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

from vla_eval.features import ACTION_KEY, DONE_KEY, REWARD_KEY
from vla_eval.models.offline_rl.configuration_offline_rl import TYPE, MikasaOfflineRLConfig
from vla_eval.models.offline_rl.network import OfflineRLNetwork
from vla_eval.models.offline_rl.objectives import OBJECTIVES, Transitions


class MikasaOfflineRLPolicy(PreTrainedPolicy):  # type: ignore[misc]  # lerobot is untyped
    """See `MikasaOfflineRLConfig`. What follows slowly is part of the weights, so that training resumes."""

    config_class: ClassVar[Any] = MikasaOfflineRLConfig
    name: ClassVar[str] = TYPE
    draws_nothing = True

    def __init__(self, config: MikasaOfflineRLConfig, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: MikasaOfflineRLConfig = config
        self.network = OfflineRLNetwork(config)

    def get_optim_params(self) -> list[dict[str, Any]]:
        """Return what is trained; the weight of the entropy does not decay."""
        trained = [(name, x) for name, x in self.named_parameters() if x.requires_grad]
        return [
            {"params": [x for _, x in trained if x.ndim > 0]},
            {"params": [x for _, x in trained if x.ndim == 0], "weight_decay": 0.0},
        ]

    def reset(self) -> None:
        """Nothing to forget."""

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of a batch of transitions, and its parts; draws from torch's global generator."""
        config = self.config
        parts = OBJECTIVES[config.algorithm](self.network, self._transitions(batch), config)
        loss = torch.stack(list(parts.values())).sum()
        return loss, {name: float(part.detach()) for name, part in parts.items()}

    def update(self) -> None:
        """Let the slow critics follow; called by the loop after each step."""
        self.network.follow()

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return (B, 1, action) for one frame per episode."""
        self.eval()
        return self.network.act(self.network.encode(self._images(batch)))[:, None]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return (B, action) for lerobot's own loop."""
        return self.predict_action_chunk(batch)[:, 0]

    def _transitions(self, batch: dict[str, Tensor]) -> Transitions:
        """Return the batch in the order in which it happened; an episode's last frame has none behind it."""
        images = self._images(batch)
        with torch.no_grad():
            later = self.network.encode(images[:, 1])
        actions = batch[ACTION_KEY][:, 0]
        is_last = batch[f"{next(iter(self.config.image_features))}_is_pad"][:, 1]
        n_samples = len(actions)
        return Transitions(
            now=self.network.encode(images[:, 0]),
            later=later,
            actions=actions,
            rewards=self._rewards(batch),
            ends=(is_last | batch[DONE_KEY].reshape(n_samples)).float(),
        )

    def _rewards(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the rewards (B,); no number for an algorithm that reads none."""
        n_samples = len(batch[ACTION_KEY])
        if self.config.reward is None:
            return batch[ACTION_KEY].new_full((n_samples,), math.nan)
        rewards = batch[REWARD_KEY].reshape(n_samples).float()
        if self.config.reward != "dense" and not bool(((rewards == 0) | (rewards == 1)).all()):
            raise ValueError(
                f"'{REWARD_KEY}' holds dense rewards, and the policy is trained on reward: "
                f"{self.config.reward}: train it with `mikasa-vla finetune`, which serves them, or set "
                "policy.reward=dense."
            )
        return rewards

    def _images(self, batch: dict[str, Tensor]) -> Tensor:
        return torch.stack([batch[key] for key in self.config.image_features], dim=-4)
