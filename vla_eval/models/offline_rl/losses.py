"""Losses of offline reinforcement learning, as functions of what networks have answered. Knows no network."""

import math

import torch
from torch import Tensor
from torch.nn import functional

MAX_WEIGHT = 100.0  # of an action in the imitation of IQL: Kostrikov et al. 2021, appendix B


def bellman_target(rewards: Tensor, ends: Tensor, next_values: Tensor, *, discount: float) -> Tensor:
    """Return (B,): the reward and, unless the episode ends, the discounted value of what follows."""
    return rewards + discount * (1 - ends) * next_values


def bellman_loss(action_values: Tensor, target: Tensor) -> Tensor:
    """Return the squared error of Q critics (Q, B), summed over critics, averaged over transitions."""
    return (action_values - target).square().mean(dim=-1).sum()


def conservative_penalty(sampled: Tensor, log_densities: Tensor, recorded: Tensor) -> Tensor:
    """Return by how much drawn actions, with these log densities (B, N), look better than recorded: CQL(H).

    Kumar et al. 2020, "Conservative Q-Learning for Offline Reinforcement Learning", equation 4 with the
    maximum over actions estimated by importance sampling (appendix F); averaged over transitions, summed
    over critics. Values are (Q, B, N) of drawn actions and (Q, B) of recorded ones.
    """
    return ((sampled - log_densities).logsumexp(dim=-1) - recorded).mean(dim=-1).sum()


def published_penalty(sampled: Tensor, recorded: Tensor) -> Tensor:
    """Return the penalty in the code of the paper's authors: one drawn action per transition.

    The maximum is taken over the batch of values (Q, B), not over the actions of a state:
    https://github.com/CognitiveAISystems/RATE/blob/5aa88f0/offline_rl_baselines/CQL.py
    """
    return (sampled.logsumexp(dim=-1) - recorded.mean(dim=-1)).sum()


def uniform_log_density(n_dims: int) -> float:
    """Return that of an action that is uniform in [-1, 1] in each dimension."""
    return -n_dims * math.log(2)


def expectile_loss(advantages: Tensor, *, expectile: float) -> Tensor:
    """Return the loss whose minimum is an expectile: Kostrikov et al. 2021, IQL, equation 5.

    Advantages (B,) above 0 have the share `expectile` of the weight.
    """
    weights = torch.where(advantages < 0, 1 - expectile, expectile)
    return (weights * advantages.square()).mean()


def advantage_weights(advantages: Tensor, *, scale: float) -> Tensor:
    """Return (B,): how much each recorded action counts in imitation: IQL, equation 7."""
    return (scale * advantages).exp().clamp(max=MAX_WEIGHT)


def squared_distance(actions: Tensor, recorded: Tensor) -> Tensor:
    """Return (B,): how far actions (B, A) are from recorded ones, squared, summed over dimensions."""
    return (actions - recorded).square().sum(dim=-1)


def squashed_log_density(mean: Tensor, log_std: Tensor, before: Tensor) -> Tensor:
    """Return the log density (…,) of the hyperbolic tangent of normal draws `before` (…, A).

    Haarnoja et al. 2018, "Soft Actor-Critic", appendix C; log(1 - tanh²) in a form that stays finite.
    """
    normal = -0.5 * ((before - mean) / log_std.exp()).square() - log_std - 0.5 * math.log(2 * math.pi)
    stretched = 2 * (math.log(2) - before - functional.softplus(-2 * before))
    return (normal - stretched).sum(dim=-1)
