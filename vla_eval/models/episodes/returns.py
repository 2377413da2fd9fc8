"""Rewards in a batch of training samples, and the return to go that sequence models read.

A policy reads rewards in training alone: none reaches it in an evaluation. Knows no network.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from vla_eval.features import REWARD_KEY, RewardKind

REWARD_PADDING_KEY = f"{REWARD_KEY}_is_pad"


def rewards_in(batch: Mapping[str, Tensor], kind: RewardKind) -> Tensor:
    """Return the rewards (B, T) of a kind at the policy's `reward_delta_indices`, 0 in padding."""
    if REWARD_PADDING_KEY not in batch:
        raise ValueError(
            f"a batch without '{REWARD_KEY}' at several steps: the dataset has no rewards, or the policy's "
            "`reward_delta_indices` name no steps."
        )
    real = ~batch[REWARD_PADDING_KEY]
    rewards = batch[REWARD_KEY].reshape(real.shape).float() * real
    is_sparse = bool(((rewards == 0) | (rewards == 1)).all()) and bool((rewards.sum(dim=1) <= 1).all())
    if kind == "sparse" and not is_sparse:
        raise ValueError(
            f"'{REWARD_KEY}' holds dense rewards, and the policy is trained on sparse ones: train it with "
            "`mikasa-vla finetune`, which serves them, or set policy.reward=dense."
        )
    return rewards


def returns_to_go(rewards: Tensor, *, discount: float = 1.0) -> Tensor:
    """Return discounted sums of rewards (B, T) from each step on (Chen et al. 2021, section 3)."""
    steps = torch.arange(rewards.shape[1], device=rewards.device)
    lag = steps[None, :] - steps[:, None]
    weights = torch.where(lag >= 0, discount ** lag.clamp(min=0).float(), 0.0)
    return rewards @ weights.T
