"""What `evaluate` only shows elsewhere stays where it is."""

from typing import Any

import numpy as np
import pytest
import torch

from tests.envs.hiding_env import HALF_M, HIDDEN_M, HIDDEN_STEPS, PLACED_M, PLACED_STEP, HidingEnv
from vla_eval.envs.true_states import TrueStates


@pytest.fixture(scope="module")
def env() -> Any:
    made = type("ShowingEnv", (TrueStates, HidingEnv), {})()
    yield made
    made.close()


def steps(env: Any, n: int) -> None:
    for _ in range(n):
        env.step(None)


def position(actor: Any) -> list[float]:
    found: list[float] = actor.pose.p[0].tolist()
    return found


def test_without_it_a_hidden_object_never_comes_back() -> None:
    plain = HidingEnv()
    plain.reset(seed=1)
    steps(plain, HIDDEN_STEPS)
    assert position(plain.hidden)[2] > HIDDEN_M / 2
    plain.close()


def test_what_is_hidden_is_shown_there_and_comes_back_where_it_was(env: Any) -> None:
    env.reset(seed=1)
    shown = []
    for _ in range(HIDDEN_STEPS + 2):
        shown.append(position(env.hidden)[2])
        env.step(None)
    assert shown[:HIDDEN_STEPS] == [HIDDEN_M] * HIDDEN_STEPS
    np.testing.assert_allclose(position(env.hidden), [0, 0, HALF_M], atol=1e-3)


def test_a_hidden_object_keeps_its_motion(env: Any) -> None:
    env.reset(seed=1)
    env.hidden.set_linear_velocity(torch.tensor([[0.2, 0.0, 0.0]]))
    steps(env, 2)
    env.put_back()
    x_m = position(env.hidden)[0]
    # 2 control steps of 0.05 s at 0.2 m/s are 0.02 m; friction leaves less.
    assert 0.001 < x_m < 0.02


def test_an_object_that_is_placed_with_a_velocity_stays_there(env: Any) -> None:
    env.reset(seed=1)
    steps(env, PLACED_STEP + 3)
    np.testing.assert_allclose(position(env.placed), PLACED_M, atol=1e-3)


def test_a_parked_object_does_not_fall(env: Any) -> None:
    env.reset(seed=1)
    steps(env, 20)
    # In the 0.05 s of the last control step it falls by 9.81 / 2 * 0.05² = 0.012 m.
    np.testing.assert_allclose(position(env.parked), [0, 1, HIDDEN_M], atol=0.02)


def test_evaluating_twice_changes_nothing(env: Any) -> None:
    env.reset(seed=1)
    steps(env, 2)
    before, counted = position(env.hidden), env.n_evaluated
    first, second = env.evaluate(), env.evaluate()
    assert env.n_evaluated == counted == 3  # of the reset and of two steps
    assert position(env.hidden) == before
    # The reward has written into its own copy.
    assert not first["success"].item() and not second["success"].item()


def test_an_episode_begins_with_nothing_left_of_the_last_one(env: Any) -> None:
    env.reset(seed=1)
    steps(env, HIDDEN_STEPS - 2)
    env.reset(seed=1)
    assert env.n_evaluated == 1
    env.put_back()
    np.testing.assert_allclose(position(env.hidden), [0, 0, HALF_M], atol=1e-6)
