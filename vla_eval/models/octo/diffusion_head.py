"""Octo's action head: noise is turned into a chunk of actions, predicted from the readout. Knows only torch.

Legend of shape suffixes: B batch, W steps of the window, F = chunk × action dimensions.

Source: https://github.com/octo-models/octo at 241fb3514b7c40957a86d869fecb7c7fc353f540 (MIT),
octo/model/components/action_heads.py:386-610 and diffusion.py; the schedule is Nichol & Dhariwal 2021
(arXiv:2102.09672), equation 17. Our own implementation.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from vla_eval.models.shared.precision import in_float32

NORM_EPSILON = 1e-6  # flax's default
SCHEDULE_OFFSET = 0.008
MAX_BETA = 0.999
LEAST_SHARE = 1e-5  # of entries that count, in the mean over them


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadSizes:
    """Octo's sizes; `condition` is the readout's width, samples are cut to ± `max_action`."""

    condition: int
    chunk: int = 4
    action: int = 7
    hidden: int = 256
    blocks: int = 3
    time: int = 32
    diffusion_steps: int = 20
    max_action: float = 5.0

    @property
    def flat(self) -> int:
        """Numbers of a chunk."""
        return self.chunk * self.action


class Schedule(NamedTuple):
    """Of T diffusion steps, each (T,): how much noise a step adds, and what is left of the action."""

    betas: Tensor
    alphas: Tensor
    alpha_products: Tensor


def cosine_schedule(n_steps: int) -> Schedule:
    """Return the schedule; computed in float64, kept in float32."""
    at = torch.linspace(0, 1, n_steps + 1, dtype=torch.float64)
    left = torch.cos((at + SCHEDULE_OFFSET) / (1 + SCHEDULE_OFFSET) * math.pi / 2) ** 2
    betas = (1 - left[1:] / left[:-1]).clamp(0, MAX_BETA).float()
    alphas = 1 - betas
    return Schedule(betas, alphas, alphas.cumprod(dim=0))


class ResidualBlock(nn.Module):
    """A norm, four times the width, and back, with a shortcut."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Return (…, width)."""
        return x + self.fc2(functional.silu(self.fc1(self.norm(x))))  # type: ignore[no-any-return]


class DiffusionHead(nn.Module):
    """See the module's text."""

    def __init__(self, sizes: HeadSizes) -> None:
        super().__init__()
        self.sizes, self.n_steps = sizes, sizes.diffusion_steps
        self.frequencies = nn.Parameter(torch.randn(sizes.time // 2, 1) * 0.2)
        self.time_fc1 = nn.Linear(sizes.time, 2 * sizes.time)
        self.time_fc2 = nn.Linear(2 * sizes.time, sizes.time)
        self.first = nn.Linear(sizes.time + sizes.condition + sizes.flat, sizes.hidden)
        self.blocks = nn.ModuleList(ResidualBlock(sizes.hidden) for _ in range(sizes.blocks))
        self.last = nn.Linear(sizes.hidden, sizes.flat)

    def schedule(self) -> Schedule:
        """Return the schedule on the head's device."""
        return Schedule(*(part.to(self.frequencies.device) for part in cosine_schedule(self.n_steps)))

    @in_float32
    def forward(self, condition: Tensor, noisy: Tensor, time: Tensor) -> Tensor:
        """Return the noise (…, F) in noisy actions (…, F), by the readout (…, width) and the step (…, 1)."""
        angles = 2 * math.pi * time.to(noisy.dtype) @ self.frequencies.T
        waves = torch.cat([angles.cos(), angles.sin()], dim=-1)
        embedded = self.time_fc2(functional.silu(self.time_fc1(waves)))
        x = self.first(torch.cat([embedded, condition, noisy], dim=-1))
        for block in self.blocks:
            x = block(x)
        return self.last(functional.silu(x))  # type: ignore[no-any-return]

    @in_float32
    def loss(self, condition_BWD: Tensor, targets: "Targets", draws: "Draws") -> Tensor:
        """Return the squared error of the predicted noise at each step, summed over dimensions."""
        schedule = self.schedule()
        actions = targets.actions.flatten(2).clamp(-self.sizes.max_action, self.sizes.max_action)
        left = schedule.alpha_products[draws.time]
        noisy = left.sqrt() * actions + (1 - left).sqrt() * draws.noise
        errors = (self(condition_BWD, noisy, draws.time) - draws.noise).square()
        counts = (targets.step_mask[..., None, None] & targets.action_mask).flatten(2).to(errors.dtype)
        mean: Tensor = (errors * counts).mean() / counts.mean().clamp(min=LEAST_SHARE)
        return mean * self.sizes.action

    @in_float32
    def sample(self, condition_BD: Tensor, noise: Tensor) -> Tensor:
        """Return chunks (B, chunk, action), normalised, from the readout of the newest step.

        `noise` (B, T + 1, F): the start, then what each of the T steps adds; the last is not used.
        """
        schedule = self.schedule()
        x = noise[:, 0]
        for index in range(self.n_steps):
            at = self.n_steps - 1 - index
            time = torch.full((len(x), 1), at, device=x.device)
            predicted = self(condition_BD, x, time)
            alpha, beta, left = schedule.alphas[at], schedule.betas[at], schedule.alpha_products[at]
            x = (x - (1 - alpha) / (1 - left).sqrt() * predicted) / alpha.sqrt()
            if at > 0:
                x = x + beta.sqrt() * noise[:, 1 + index]
            x = x.clamp(-self.sizes.max_action, self.sizes.max_action)
        return x.reshape(len(x), self.sizes.chunk, self.sizes.action)


class Targets(NamedTuple):
    """Normalised actions (B, W, chunk, action), which of them count, and which steps are the episode's."""

    actions: Tensor
    action_mask: Tensor
    step_mask: Tensor


class Draws(NamedTuple):
    """What chance decides in a training step: `time` (B, W, 1) of integers, `noise` (B, W, F)."""

    time: Tensor
    noise: Tensor


def draw(sizes: HeadSizes, shape: torch.Size, device: torch.device) -> Draws:
    """Draw for steps of shape (B, W) from torch's global generator, which the training loop seeds."""
    return Draws(
        time=torch.randint(0, sizes.diffusion_steps, (*shape, 1), device=device),
        noise=torch.randn(*shape, sizes.flat, device=device),
    )
