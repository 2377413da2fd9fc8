"""Policies from offline reinforcement learning as a LeRobot policy: single frames in, single actions out."""

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple  # lerobot is untyped

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor
from torch.nn import functional

from vla_eval.features import ACTION_KEY, DONE_KEY, REWARD_KEY
from vla_eval.models.episodes.samples import stacked_images
from vla_eval.models.offline_rl.configuration_offline_rl import TYPE, MikasaOfflineRLConfig
from vla_eval.models.offline_rl.losses import (
    advantage_weights,
    bellman_loss,
    bellman_target,
    conservative_penalty,
    expectile_loss,
    published_penalty,
    squared_distance,
    uniform_log_density,
)
from vla_eval.models.offline_rl.network import OfflineRLNetwork


class Transitions(NamedTuple):
    """B transitions: encodings (B, D) now and later (no gradient), actions (B, A), rewards, 1 at an end."""

    now: Tensor
    later: Tensor
    actions: Tensor
    rewards: Tensor
    ends: Tensor


Parts = dict[str, Tensor]
Objective = Callable[[OfflineRLNetwork, Transitions, MikasaOfflineRLConfig], Parts]


def cql(network: OfflineRLNetwork, seen: Transitions, config: MikasaOfflineRLConfig) -> Parts:
    """Conservative Q-learning with a soft actor: Kumar et al. 2020, CQL(H) on SAC.

    As in its code, entropy is not part of the right side of Bellman's equation, and its weight is learned for
    an entropy of -A. The encoder learns from critics and imitation, not from what the critics tell the actor.
    """
    with torch.no_grad():
        following = network.draw(seen.later).actions
        next_values = network.slow_values(seen.later, following)
    target = bellman_target(seen.rewards, seen.ends, next_values, discount=config.discount)
    recorded = network.critics(seen.now, seen.actions)
    penalty = conservative_penalty(*_sampled(network, seen, config.n_sampled_actions), recorded)

    drawn = network.draw(seen.now.detach())
    entropy_weight = network.log_entropy_weight.exp().detach()
    too_sure = (drawn.log_densities - network.n_numbers).detach()
    actor = (entropy_weight * drawn.log_densities - network.judge(seen.now, drawn.actions)).mean()
    imitation = functional.mse_loss(network.act(seen.now), seen.actions)
    return {
        "bellman": bellman_loss(recorded, target),
        "conservative": config.conservative_weight * penalty,
        "actor": actor,
        "imitation": config.imitation_weight * imitation,
        "entropy": -(network.log_entropy_weight * too_sure).mean(),
    }


def _sampled(network: OfflineRLNetwork, seen: Transitions, n: int) -> tuple[Tensor, Tensor]:
    """Return values (Q, B, 3 n) and log densities of draws: uniform, the actor's now, its later ones."""
    with torch.no_grad():
        of_actor = [network.draw(encoded, n) for encoded in (seen.now, seen.later)]
        uniform = 2 * torch.rand_like(of_actor[0].actions) - 1
        log_densities = torch.full_like(of_actor[0].log_densities, uniform_log_density(network.n_numbers))
        actions = torch.cat([uniform, *(drawn.actions for drawn in of_actor)])
        log_densities = torch.cat([log_densities, *(drawn.log_densities for drawn in of_actor)])
    values = network.critics(seen.now.expand(3 * n, -1, -1), actions)
    return values.transpose(1, 2), log_densities.T


def cql_published(network: OfflineRLNetwork, seen: Transitions, config: MikasaOfflineRLConfig) -> Parts:
    """What the code of the paper's authors minimises under this name; it reads no rewards.

    Imitation, and a penalty that reaches the actor by the encoder alone:
    https://github.com/CognitiveAISystems/RATE/blob/5aa88f0/offline_rl_baselines/CQL.py
    """
    random = torch.randn_like(seen.actions).clamp(-1, 1)
    penalty = published_penalty(network.critics(seen.now, random), network.critics(seen.now, seen.actions))
    return {
        "conservative": config.conservative_weight * penalty,
        "imitation": config.imitation_weight * functional.mse_loss(network.act(seen.now), seen.actions),
    }


def iql(network: OfflineRLNetwork, seen: Transitions, config: MikasaOfflineRLConfig) -> Parts:
    """Implicit Q-learning: Kostrikov et al. 2021, with an actor of fixed variance."""
    advantages = network.slow_values(seen.now, seen.actions) - network.value(seen.now).squeeze(-1)
    with torch.no_grad():
        next_values = network.value(seen.later, drops=False).squeeze(-1)
    target = bellman_target(seen.rewards, seen.ends, next_values, discount=config.discount)
    weights = advantage_weights(advantages.detach(), scale=config.advantage_scale)
    missed = squared_distance(network.act(seen.now), seen.actions)
    return {
        "value": expectile_loss(advantages, expectile=config.expectile),
        "bellman": bellman_loss(network.critics(seen.now, seen.actions), target),
        "imitation": (weights * missed).mean(),
    }


OBJECTIVES: Mapping[str, Objective] = {"cql": cql, "cql_published": cql_published, "iql": iql}


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
        return self.network.act(self.network.encode(stacked_images(batch, self.config)))[:, None]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return (B, action) for lerobot's own loop."""
        return self.predict_action_chunk(batch)[:, 0]

    def _transitions(self, batch: dict[str, Tensor]) -> Transitions:
        """Return the batch in the order in which it happened; an episode's last frame has none behind it."""
        images = stacked_images(batch, self.config)
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
