"""BunchOfColors, SeqOfColors, ChainOfColors: what is shown when, and what counts as found."""

from typing import Any

import numpy as np
import pytest

from tests.tasks import made_tasks
from vla_eval.errors import TaskArgumentError
from vla_eval.tasks.memory_env import PARK_X_M
from vla_eval.tasks.objects.layout import bunch_place_m

ABOVE_CUBE_M = np.array([0.0, 0.0, 0.036])  # within 2 cm of the point to touch, 1 cm over the cube


ENVS: dict[str, Any] = {}


def make(task: str, **kwargs: Any) -> Any:
    """An environment, built once per task and arguments; its scene is used again, which is exact enough."""
    key = f"{task} {sorted(kwargs.items())}"
    if key not in ENVS:
        ENVS[key] = made_tasks.make(task, **{"reward_mode": "dense", "reconfiguration_freq": 0, **kwargs})
    return ENVS[key]


def visible(env: Any) -> list[int]:
    x = env.candidate_positions_m()[0, :, 0]
    return [int(i) for i in np.flatnonzero(x < PARK_X_M - 1)]


def touch(env: Any, index: int, n_steps: int = 16) -> Any:
    """Go over a cube and rest there; return the last info and the rewards on the way."""
    goal = env.candidate_positions_m()[0, index] + ABOVE_CUBE_M
    rewards, info = [], None
    for _ in range(n_steps):
        action = np.zeros((1, 7), dtype=np.float32)
        action[0, :3] = (9 * (goal - env.tcp_position_m()[0])).clip(-1, 1)
        action[0, 6] = 1
        _, reward, *_, info = env.step(action)
        rewards.append(float(reward[0]))
    return info, rewards


def begin(task: str, **kwargs: Any) -> Any:
    """An episode whose choice can be made at once: 1 step of cue per cube, no delay."""
    env = make(task, cue_steps=1, delay_steps=0, **kwargs)
    env.reset(seed=[1])
    for _ in range(int(env._response_step[0])):
        env.step(env.hold_action())
    return env


def test_a_bunch_is_shown_together_and_then_all_cubes_lie_still_on_the_table() -> None:
    env = make("BunchOfColors5-v0")
    env.reset(seed=[1])
    shown = sorted(env.right_candidates(0))
    assert len(set(shown)) == 5
    for step in range(14):
        positions = env.candidate_positions_m()[0]
        assert visible(env) == (shown if step < 5 else [] if step < 10 else list(range(9))), step
        if step < 5:
            for index in shown:
                expected = np.array([*bunch_place_m(index, 9), 0.02])
                assert np.allclose(positions[index], expected, atol=2e-4)
        if step >= 10:
            assert np.allclose(positions, env._slots[0], atol=2e-4)
        env.step(env.hold_action())


@pytest.mark.parametrize(("task", "n_shown"), [("SeqOfColors3-v0", 3), ("ChainOfColors5-v0", 5)])
def test_a_sequence_is_shown_one_cube_after_another(task: str, n_shown: int) -> None:
    env = make(task)
    env.reset(seed=[4])
    sequence = env.right_candidates(0)
    # 5 steps each, 5 of delay: the choice begins at 5 L + 5.
    for step in range(5 * n_shown + 8):
        if step < 5 * n_shown:
            assert visible(env) == [sequence[step // 5]], step
            place = env.candidate_positions_m()[0, sequence[step // 5]]
            assert np.allclose(place, np.array([0, 0, 0.02]), atol=2e-4)
        else:
            assert visible(env) == ([] if step < 5 * n_shown + 5 else list(range(9))), step
        env.step(env.hold_action())


def test_cubes_are_told_apart_by_an_empty_table_if_asked_for() -> None:
    env = make("SeqOfColors3-v0", cue_steps=2, gap_steps=3, delay_steps=4)
    env.reset(seed=[2])
    first, second, third = env.right_candidates(0)
    seen = []
    for _ in range(18):
        seen.append(tuple(visible(env)))
        env.step(env.hold_action())
    gap, everything = [()] * 3, tuple(range(9))
    expected = [(first,)] * 2 + gap + [(second,)] * 2 + gap + [(third,)] * 2 + [()] * 4 + [everything] * 2
    assert seen == expected


def test_per_cube_durations_are_drawn_per_episode() -> None:
    env = make("SeqOfColors3-v0", cue_steps=(1, 4))
    lengths = set()
    for seed in range(1, 25):
        _, info = env.reset(seed=[seed])
        lengths.add(int(info["cue_steps"][0]))
    assert lengths == {3, 6, 9, 12}


def test_a_bunch_is_found_in_any_order_and_success_needs_all_of_it() -> None:
    env = begin("BunchOfColors3-v0")
    order = sorted(env.right_candidates(0), reverse=True)
    for n_found, index in enumerate(order, start=1):
        info, rewards = touch(env, index)
        assert int(info["n_found"][0]) == n_found
        assert bool(info["success"][0]) == (n_found == 3)
        assert all(np.isfinite(rewards))
        assert max(rewards) <= 100
        # 90 per share found, and at most 1 + 0.5 for being near and slow.
        if n_found < 3:
            assert 30 * n_found <= rewards[-1] <= 30 * n_found + 1.5
    assert rewards[-1] == 100
    assert (int(info["n_wrong_choices"][0]), int(info["first_choice"][0])) == (0, order[0])


def test_a_wrong_cube_spoils_the_episode_for_good() -> None:
    env = begin("BunchOfColors3-v0")
    right = env.right_candidates(0)
    wrong = next(i for i in range(9) if i not in right)
    info, _ = touch(env, wrong)
    assert not bool(info["fail"][0])  # the episode goes on, as in the official code
    for index in right:
        info, _ = touch(env, index)
    assert (int(info["n_found"][0]), int(info["n_wrong_choices"][0])) == (3, 1)
    assert not bool(info["success"][0])


def test_strict_choice_ends_the_episode_at_the_first_mistake() -> None:
    env = begin("ChainOfColors3-v0", strict_choice=True)
    info, _ = touch(env, env.right_candidates(0)[1])  # it was shown, but is not the first
    assert bool(info["fail"][0])


def test_a_chain_must_be_touched_in_the_order_shown() -> None:
    env = begin("ChainOfColors3-v0")
    for index in env.right_candidates(0):
        info, _ = touch(env, index)
    assert bool(info["success"][0])
    first, second, third = env.right_candidates(0)
    env = begin("ChainOfColors3-v0")
    for index in (second, first, third):
        info, _ = touch(env, index)
    assert not bool(info["success"][0])
    assert int(info["n_wrong_choices"][0]) >= 1
    assert env.status(env.get_info(), 0).right_first_choices == (first,)


def test_a_touch_can_be_asked_to_last() -> None:
    """With 20 steps of dwelling, 16 steps to a cube are no touch, and 20 more are one."""
    env = begin("BunchOfColors3-v0", dwell_steps=20)
    index = env.right_candidates(0)[0]
    info, _ = touch(env, index)
    assert int(info["n_found"][0]) == 0
    info, _ = touch(env, index, n_steps=20)
    assert int(info["n_found"][0]) == 1


def test_cubes_of_another_size_are_touched_half_a_centimetre_over_their_tops() -> None:
    env = begin("BunchOfColors3-v0", cube_half_size_m=0.015)
    centres = env.candidate_positions_m()[0]
    assert np.allclose(centres[:, 2], np.array(0.015), atol=2e-4)
    assert np.allclose(env.touch_points_m()[0, :, 2], np.array(0.015 + 0.015 + 0.005), atol=2e-4)


def test_bunches_sequences_and_chains_of_a_seed_differ() -> None:
    found = set()
    for family in ("BunchOfColors", "SeqOfColors", "ChainOfColors"):
        env = make(f"{family}5-v0")
        env.reset(seed=[3])
        found.add(env.right_candidates(0))
    assert len(found) == 3


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_shown": 10}, "n_shown=10: expected 1 to 9"),
        ({"n_items": 6, "n_shown": 7}, "n_shown=7: expected at most n_items=6"),
        ({"n_items": 10}, "n_items=10: expected 2 to 9"),
        ({"gap_steps": 2}, "shown together"),
        ({"dwell_steps": 0}, "dwell_steps=0: expected 1"),
        ({"cube_half_size_m": 0.05}, "cube_half_size_m=0.05: expected 0.01 to 0.03"),
        ({"phase_gate_success": False}, "in these tasks touches count only in the response phase"),
    ],
)
def test_impossible_arguments_are_refused_with_a_reason(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(TaskArgumentError, match=message):
        make("BunchOfColors3-v0", **kwargs)
