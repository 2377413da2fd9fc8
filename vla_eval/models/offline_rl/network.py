"""Encoder, actor and critics (B batch, D encoder, A action, Q critics, … any axes). Knows no loss."""

import copy
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from vla_eval.models.offline_rl.configuration_offline_rl import ALGORITHMS, MikasaOfflineRLConfig
from vla_eval.models.offline_rl.losses import squashed_log_density
from vla_eval.models.sequence.encoders import RGB, Nature

N_CRITICS = 2
LOG_STD_BOUNDS = (-20.0, 2.0)  # Haarnoja et al. 2018, SAC; so that no probability is infinite


class Drawn(NamedTuple):
    """Actions (…, A) in [-1, 1] that were drawn, and their log densities (…,)."""

    actions: Tensor
    log_densities: Tensor


class Perceptron(nn.Module):
    """Two layers of rectified units with dropout in training, and a linear one."""

    def __init__(self, inputs: int, hidden: int, outputs: int, *, dropout: float) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(inputs, hidden), nn.Linear(hidden, hidden)
        self.last, self.dropout = nn.Linear(hidden, outputs), dropout

    def forward(self, inputs: Tensor, *, drops: bool = True) -> Tensor:
        """Return (…, outputs) of (…, inputs); without dropout if `drops` is false."""
        units = inputs
        for layer in (self.first, self.second):
            units = functional.dropout(layer(units).relu(), self.dropout, self.training and drops)
        answered: Tensor = self.last(units)
        return answered


class Critics(nn.Module):
    """Two networks that say what an action is worth."""

    def __init__(self, inputs: int, hidden: int, *, dropout: float) -> None:
        super().__init__()
        self.each = nn.ModuleList(Perceptron(inputs, hidden, 1, dropout=dropout) for _ in range(N_CRITICS))

    def forward(self, encoded: Tensor, actions: Tensor, *, drops: bool = True) -> Tensor:
        """Return the values (Q, …) of actions (…, A) where the encoder returned (…, D)."""
        both = torch.cat([encoded, actions], dim=-1)
        return torch.stack([critic(both, drops=drops).squeeze(-1) for critic in self.each])


class OfflineRLNetwork(nn.Module):
    """All parts; those that the algorithm does not have are absent."""

    def __init__(self, config: MikasaOfflineRLConfig) -> None:
        super().__init__()
        row, width, images = ALGORITHMS[config.algorithm], config.width, config.image_features
        image_px = int(next(iter(images.values())).shape[-1])
        n_numbers = int(config.action_feature.shape[0])
        self.encoder = Nature(image_px=image_px, outputs=width, channels=RGB * len(images))
        n_answers = 2 * n_numbers if row.draws_actions else n_numbers
        self.actor = Perceptron(width, config.hidden, n_answers, dropout=config.dropout)
        self.critics = Critics(width + n_numbers, config.hidden, dropout=config.dropout)
        self.n_numbers, self.target_rate = n_numbers, config.target_rate
        if row.has_value:
            self.value = Perceptron(width, config.hidden, 1, dropout=config.dropout)
        if row.has_targets:
            self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        if row.draws_actions:
            self.log_entropy_weight = nn.Parameter(torch.zeros(()))

    def encode(self, images: Tensor) -> Tensor:
        """Return (…, D) of both cameras' images (…, cameras, 3, H, W) in [0, 1], as six channels."""
        channels = images.flatten(-4, -3)
        encoded: Tensor = self.encoder(channels.flatten(0, -4)).unflatten(0, channels.shape[:-3])
        return encoded

    def act(self, encoded: Tensor) -> Tensor:
        """Return the action (…, A) of a deterministic actor, or the middle of a distribution."""
        middle: Tensor = self.actor(encoded)[..., : self.n_numbers].tanh()
        return middle

    def draw(self, encoded: Tensor, *shape: int) -> Drawn:
        """Draw actions (*shape, …, A) by torch's generator, for an actor that is a distribution."""
        mean, log_std = self.actor(encoded).expand(*shape, *encoded.shape[:-1], -1).chunk(2, dim=-1)
        log_std = log_std.clamp(*LOG_STD_BOUNDS)
        before = mean + log_std.exp() * torch.randn_like(mean)
        return Drawn(before.tanh(), squashed_log_density(mean, log_std, before))

    def judge(self, encoded: Tensor, actions: Tensor) -> Tensor:
        """Return the lowest of the critics' values (…,); its gradient reaches the actions alone."""
        fixed = {name: weight.detach() for name, weight in self.critics.named_parameters()}
        values: Tensor = functional_call(self.critics, fixed, (encoded.detach(), actions))
        return values.amin(dim=0)

    @torch.no_grad()
    def slow_values(self, encoded: Tensor, actions: Tensor) -> Tensor:
        """Return the lowest value (…,) of the slow critics."""
        lowest: Tensor = self.targets(encoded, actions, drops=False).amin(dim=0)
        return lowest

    @torch.no_grad()
    def follow(self) -> None:
        """Let the slow critics come closer to the others, if there are any."""
        if hasattr(self, "targets"):
            for slow, fast in zip(self.targets.parameters(), self.critics.parameters(), strict=True):
                slow.lerp_(fast, self.target_rate)
