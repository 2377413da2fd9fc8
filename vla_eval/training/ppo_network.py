"""Actor and critic on the true state of the world, and their file. Knows only torch and safetensors."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

# Hidden objects are parked 150 m away. Such a number would drown the centimetres that matter in the running
# variance: what is beyond every pose and velocity of arm and table is just not there, as the simulator's own
# state has zeros for wrong candidates.
ABSENT_BEYOND = 20.0
NORMALIZED_LIMIT = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkSpec:
    """Sizes of actor and critic, and the spread of the first actions."""

    n_state: int
    n_action: int
    hidden: tuple[int, ...] = (128, 128)
    initial_std: float = 0.4


class Decision(NamedTuple):
    """(B, A) actions, (B,) their log-probability, (B,) value of the state."""

    actions: Tensor
    log_probability: Tensor
    value: Tensor


class ActorCritic(nn.Module):
    """Two tanh networks and a running normalisation of their input, all of it in `state_dict()`.

    Source: CleanRL's `ppo_continuous_action.py` for the initialisation and the state-independent spread.
    """

    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, spec: NetworkSpec) -> None:
        super().__init__()
        self.spec = spec
        self.actor = _mlp((spec.n_state, *spec.hidden, spec.n_action), last_gain=0.01)
        self.critic = _mlp((spec.n_state, *spec.hidden, 1), last_gain=1.0)
        self.log_std = nn.Parameter(torch.full((spec.n_action,), math.log(spec.initial_std)))
        self.register_buffer("mean", torch.zeros(spec.n_state))
        self.register_buffer("variance", torch.ones(spec.n_state))
        self.register_buffer("count", torch.tensor(1e-4))

    def observe(self, states: Tensor) -> None:
        """Take (N, D) states into the running mean and variance. Source: Chan et al., parallel variance."""
        states = _present(states)
        n_new, total = len(states), self.count + len(states)
        delta = states.mean(0) - self.mean
        m2 = self.variance * self.count + states.var(0, unbiased=False) * n_new
        self.mean += delta * n_new / total
        self.variance.copy_((m2 + delta**2 * self.count * n_new / total) / total)
        self.count.copy_(total)

    def normalize(self, states: Tensor) -> Tensor:
        """Return (B, D) states with mean 0 and variance 1, bounded."""
        centred = _present(states) - self.mean
        return (centred / torch.sqrt(self.variance + 1e-8)).clamp(-NORMALIZED_LIMIT, NORMALIZED_LIMIT)

    def best_actions(self, normalized: Tensor) -> Tensor:
        """Return the (B, A) most likely actions."""
        actions: Tensor = self.actor(normalized)
        return actions

    def decide(self, normalized: Tensor, *, noise: Tensor) -> Decision:
        """Draw actions with standard normal (B, A) noise."""
        means = self.best_actions(normalized)
        actions = means + noise * self.log_std.exp()
        return self._judged(normalized, means, actions)

    def judge(self, normalized: Tensor, actions: Tensor) -> Decision:
        """Return how likely the given actions are, and the values."""
        return self._judged(normalized, self.best_actions(normalized), actions)

    def _judged(self, normalized: Tensor, means: Tensor, actions: Tensor) -> Decision:
        density = torch.distributions.Normal(means, self.log_std.exp().expand_as(means))
        log_probability = density.log_prob(actions).sum(1)  # type: ignore[no-untyped-call]  # torch
        return Decision(actions, log_probability, self.critic(normalized).squeeze(1))


def _present(states: Tensor) -> Tensor:
    return torch.where(states.abs() > ABSENT_BEYOND, 0.0, states)


def _mlp(sizes: Sequence[int], *, last_gain: float) -> nn.Sequential:
    layers: list[nn.Module] = []
    for index, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
        layer = nn.Linear(n_in, n_out)
        is_last = index == len(sizes) - 2
        nn.init.orthogonal_(layer.weight, last_gain if is_last else math.sqrt(2))
        nn.init.zeros_(layer.bias)
        layers += [layer] if is_last else [layer, nn.Tanh()]
    return nn.Sequential(*layers)
