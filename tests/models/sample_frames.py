"""Frames of episodes with random images and states, as a LeRobot policy gets them."""

import torch

BASE, WRIST = "observation.images.base", "observation.images.wrist"


def frames(n_steps: int, *, n_episodes: int = 1) -> dict[str, torch.Tensor]:
    draws = torch.Generator().manual_seed(1)
    return {
        BASE: torch.rand(n_episodes, n_steps, 3, 128, 128, generator=draws),
        WRIST: torch.rand(n_episodes, n_steps, 3, 128, 128, generator=draws),
        "observation.state": torch.rand(n_episodes, n_steps, 10, generator=draws),
    }


def at(batch: dict[str, torch.Tensor], step: int) -> dict[str, torch.Tensor]:
    return {key: values[:, step] for key, values in batch.items()}


def between(batch: dict[str, torch.Tensor], first: int, stop: int) -> dict[str, torch.Tensor]:
    return {key: values[:, first:stop] for key, values in batch.items()}
