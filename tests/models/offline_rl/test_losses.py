"""Losses of offline reinforcement learning, against hand-computed values and those of original code."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from vla_eval.models.offline_rl.losses import (
    MAX_WEIGHT,
    advantage_weights,
    bellman_loss,
    bellman_target,
    conservative_penalty,
    expectile_loss,
    published_penalty,
    squared_distance,
    squashed_log_density,
    uniform_log_density,
)

GOLDEN = Path(__file__).parents[2] / "golden" / "offline_rl" / "published.json"


def published(algorithm: str) -> dict[str, Any]:
    return dict(json.loads(GOLDEN.read_text())[algorithm])


def test_the_published_penalty_is_that_of_the_original_code() -> None:
    golden = published("cql")
    penalty = published_penalty(torch.tensor(golden["sampled"]), torch.tensor(golden["recorded"]))
    assert float(penalty) == pytest.approx(golden["penalty"], abs=1e-5)


def test_the_losses_of_iql_are_those_of_the_original_code() -> None:
    golden = {name: torch.tensor(values) for name, values in published("iql").items()}
    advantages = golden["slow"].amin(dim=0) - golden["values"]
    target = bellman_target(golden["rewards"], golden["ends"], golden["next_values"], discount=0.99)
    weights = advantage_weights(advantages, scale=1.0)
    imitation = (weights * squared_distance(golden["actor"], golden["recorded"])).mean()
    found = {
        "v_loss": expectile_loss(advantages, expectile=0.7),
        "q_loss": bellman_loss(golden["critics"], target),
        "policy_loss": imitation,
        "exp_adv_mean": weights.mean(),
    }
    for name, value in found.items():
        torch.testing.assert_close(value, golden[name], atol=2e-5, rtol=0)


def test_nothing_follows_the_end_of_an_episode() -> None:
    rewards, ends, later = torch.tensor([0.0, 1.0]), torch.tensor([0.0, 1.0]), torch.tensor([2.0, 5.0])
    assert bellman_target(rewards, ends, later, discount=0.9).tolist() == pytest.approx([1.8, 1.0])


def test_the_penalty_sums_what_was_drawn_over_the_actions_of_a_state_not_over_the_batch() -> None:
    sampled = torch.tensor([[[0.0, 1.0, 2.0], [1.0, 1.0, 1.0]]])  # one critic, two states, three actions
    densities = torch.tensor([[0.0, -1.0, 0.5], [0.0, 0.0, 0.0]])
    recorded = torch.tensor([[0.5, -1.0]])
    # State 1: log(e^0 + e^2 + e^1.5) - 0.5; state 2: log(3 e) + 1.
    first = math.log(1 + math.exp(2) + math.exp(1.5)) - 0.5
    second = math.log(3) + 2
    penalty = conservative_penalty(sampled, densities, recorded)
    assert float(penalty) == pytest.approx((first + second) / 2)


def test_importance_sampling_makes_the_penalty_independent_of_where_actions_are_drawn() -> None:
    """The integral of exp(a) over [-1, 1] is e - 1/e, whatever the draws' density."""
    generator = torch.Generator().manual_seed(0)
    uniform = 2 * torch.rand(200_000, generator=generator) - 1
    edged = uniform.abs().sqrt() * uniform.sign()  # density |a| on [-1, 1]
    expected = math.log(math.e - 1 / math.e)
    for drawn, log_density in (
        (uniform, torch.full_like(uniform, uniform_log_density(1))),
        (edged, edged.abs().log()),
    ):
        penalty = conservative_penalty(drawn[None, None], log_density[None], torch.zeros(1, 1))
        assert float(penalty) - math.log(len(drawn)) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(("expectile", "answer"), [(0.5, 2.0), (0.9, 3.6)])
def test_the_minimum_of_the_expectile_loss_is_the_expectile(expectile: float, answer: float) -> None:
    """Of 0 and 4: expectile · (4 - v) = (1 - expectile) · v, so that v = 4 · expectile."""
    value = torch.tensor(answer, requires_grad=True)
    expectile_loss(torch.tensor([0.0, 4.0]) - value, expectile=expectile).backward()
    assert float(value.grad if value.grad is not None else math.nan) == pytest.approx(0, abs=1e-5)


def test_no_action_counts_without_bound() -> None:
    weights = advantage_weights(torch.tensor([-1.0, 0.0, 50.0]), scale=2.0)
    assert weights.tolist() == pytest.approx([math.exp(-2), 1.0, MAX_WEIGHT])


def test_the_density_of_a_squashed_draw_is_torchs_and_finite_at_the_edge() -> None:
    mean, log_std = torch.tensor([[0.3, -0.2]]), torch.tensor([[-0.5, 0.1]])
    before = torch.tensor([[0.1, 0.9]])
    normal = torch.distributions.Normal(mean, log_std.exp())
    squashed = torch.distributions.TransformedDistribution(normal, [torch.distributions.TanhTransform()])
    expected: Tensor = squashed.log_prob(before.tanh()).sum(dim=-1)
    torch.testing.assert_close(squashed_log_density(mean, log_std, before), expected, atol=1e-4, rtol=0)
    assert bool(squashed_log_density(mean, log_std, torch.full((1, 2), 40.0)).isfinite().all())
