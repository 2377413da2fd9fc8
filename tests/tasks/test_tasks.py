"""What the tasks promise, on the CPU simulator and without a renderer."""

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import vla_eval.tasks.register  # noqa: F401  # registers the gym ids
from tests.tasks.made_tasks import make
from vla_eval.core import FloatArray
from vla_eval.tasks.catalog import TASKS, task_spec
from vla_eval.tasks.memory_env import PARK_X_M

CHOICE_TASKS = [task for task, spec in TASKS.items() if spec.candidates]


def pressing_actions(seed: int, n_steps: int) -> Iterator[np.ndarray]:
    """Actions that press the closed gripper onto the table and whatever lies there."""
    rng = np.random.default_rng(seed)
    for _ in range(n_steps):
        yield np.array([rng.uniform(-0.3, 0.6), rng.uniform(-0.6, 0.6), -0.6, 0, 0, 0, -1], dtype=np.float32)


def trajectory(env: Any, seed: int, n_steps: int = 25) -> np.ndarray:
    """The full simulator state at each step of an episode with much contact."""
    env.reset(seed=[seed])
    states = [env.get_state()[0].numpy().copy()]
    for action in pressing_actions(seed, n_steps):
        env.step(action)
        states.append(env.get_state()[0].numpy().copy())
    return np.stack(states)


def visible(env: Any) -> list[int]:
    """Indices of the candidates that are not parked."""
    x = env.candidate_positions_m()[0, :, 0]
    return [int(i) for i in np.flatnonzero(x < PARK_X_M - 1)]


@pytest.mark.parametrize(
    ("task", "n_numbers"),
    # qpos 9 + qvel 9 + tcp 7 = 25, and: oracle 1 + 3 per cube; mug 7 + ball 7 + oracle 1; see docs/tasks.md.
    [
        ("RememberColor3-v0", 25 + 1 + 3 * 3),
        ("RememberColor5-v0", 25 + 1 + 3 * 5),
        ("RememberColor9-v0", 25 + 1 + 3 * 9),
        ("RememberShape5-v0", 25 + 1 + 3 * 5),
        ("RememberShapeAndColor3x2-v0", 25 + 2 + 3 * 6),
        ("RememberShapeAndColor5x3-v0", 25 + 2 + 3 * 15),
        # Vector to the next cube 3, sequence L, and 3 + 3 per cube: 85, 87, 89.
        ("BunchOfColors3-v0", 25 + 3 + 3 + 9 * 6),
        ("SeqOfColors5-v0", 25 + 3 + 5 + 9 * 6),
        ("ChainOfColors7-v0", 25 + 3 + 7 + 9 * 6),
        ("ShellGameTouch-v0", 25 + 7 + 7 + 1),
        ("ShellGamePush-v0", 25 + 3 + 7 + 7 + 1),
        ("ShellGamePick-v0", 25 + 3 + 7 + 7 + 1 + 1),
        ("InterceptMedium-v0", 25 + 3 + 7 + 3 + 3 + 3 + 3 + 3),
        ("InterceptGrabFast-v0", 25 + 7 + 3 + 1 + 3 + 3 + 3 + 1 + 3),
        ("RotateLenientPos-v0", 25 + 1 + 7),
        ("RotateStrictPosNeg-v0", 25 + 1 + 7),
        ("TakeItBack-v0", 25 + 3 + 7 + 3 + 1),
    ],
)
def test_state_observation_has_the_official_size(task: str, n_numbers: int) -> None:
    obs, _ = make(task, obs_mode="state").reset(seed=[1])
    assert tuple(obs.shape) == (1, n_numbers)


def test_gym_make_gives_the_task_with_horizon_instruction_and_info(sampled_task: str) -> None:
    env = gymnasium.make(
        f"vla_eval_maniskill/{sampled_task}",
        obs_mode="state",
        control_mode="pd_ee_delta_pose",
        render_backend="none",
    )
    _, info = env.reset(seed=1)
    assert {"success", "elapsed_steps", "oracle_info", "phase", "cue_steps", "delay_steps"} <= set(info)
    assert len(info["language_instruction"][0]) > 20
    if sampled_task in CHOICE_TASKS:
        assert {"first_choice", "n_wrong_choices", "fail", "is_obj_placed", "obj_to_goal_pos"} <= set(info)
    for step in range(1, task_spec(sampled_task).horizon_steps + 1):
        *_, truncated, info = env.step(env.unwrapped.hold_action())
        assert bool(truncated) == (step == task_spec(sampled_task).horizon_steps)


@pytest.mark.parametrize(
    "task",
    [
        *("RememberColor3-v0", "RememberColor9-v0", "RememberShape9-v0", "RememberShapeAndColor5x3-v0"),
        "RememberObject9-v0",
    ],
)
def test_item_is_shown_hidden_and_then_all_items_lie_still_on_the_table(task: str) -> None:
    env = make(task)
    for seed in (1, 2, 3):
        env.reset(seed=[seed])
        target = int(env.target_index()[0])
        heights = np.array([item.shape.rest_height_m for item in env.items])
        for step in range(20):
            positions = env.candidate_positions_m()[0]
            if step < 5:
                assert visible(env) == [target], f"step {step}"
                middle = np.array([0, 0, float(heights[target])])
                assert np.allclose(positions[target], middle, atol=2e-4)
            elif step < 10:
                assert visible(env) == [], f"step {step}"
            else:
                assert len(visible(env)) == env.n_items, f"step {step}"
                assert np.allclose(positions, env._slots[0], atol=2e-4)
                assert np.allclose(positions[:, 2], heights, atol=2e-4)
            env.step(env.hold_action())


def test_three_by_two_is_three_shapes_in_two_colors_unless_the_official_one_is_asked_for() -> None:
    ours = make("RememberShapeAndColor3x2-v0")
    official = make("RememberShapeAndColor3x2-v0", official_3x2=True)
    assert {item.shape.name for item in ours.items} == {"cube", "sphere", "t_shape"}
    assert {item.color.name for item in ours.items} == {"red", "green"}
    assert {item.shape.name for item in official.items} == {"cube", "sphere"}
    assert {item.color.name for item in official.items} == {"red", "green", "blue"}


def test_ball_is_shown_and_then_mugs_stand_upright_on_the_table_one_over_the_ball() -> None:
    env = make("ShellGameTouch-v0")
    for seed in (1, 2, 3):
        env.reset(seed=[seed])
        target = int(env.target_index()[0])
        for step in range(30):
            ball = env.ball.pose.p[0].numpy()
            assert np.allclose(ball[:2], env._slots[0, target, :2], atol=1e-3)
            assert visible(env) == ([] if step < 5 else [0, 1, 2]), f"step {step}"
            if step >= 5:
                mugs = env.candidate_positions_m()[0]
                # Half of the mug's height: nothing is ejected, tilted or sunk, as in the official code.
                assert np.allclose(mugs[:, 2], np.array(0.0405), atol=5e-4), f"step {step}"
                assert np.allclose(mugs[:, :2], env._slots[0, :, :2], atol=1e-3), f"step {step}"
            env.step(env.hold_action())


@pytest.mark.sampled(3)
def test_an_episode_has_no_past(sampled_task: str) -> None:
    """Bit-equal states in a fresh environment, and in one used for other episodes, in any order."""
    env = make(sampled_task)
    first = {seed: trajectory(env, seed) for seed in (5, 6)}
    torch.manual_seed(999)
    np.random.seed(999)  # noqa: TID251  # global state must not matter
    again = {seed: trajectory(env, seed) for seed in (6, 5)}
    fresh = trajectory(make(sampled_task), 6)
    assert np.array_equal(first[5], again[5])
    assert np.array_equal(first[6], again[6])
    assert np.array_equal(first[6], fresh)
    assert not np.array_equal(first[5], first[6])


def test_evaluate_changes_nothing(sampled_task: str) -> None:
    env = make(sampled_task)
    env.reset(seed=[3])
    for action in pressing_actions(3, 12):
        env.step(action)
        before = env.get_state().clone()
        first, second = env.evaluate(), env.evaluate()
        assert torch.equal(before, env.get_state())
        assert all(np.array_equal(first[key], second[key]) for key in first)


def test_unseeded_resets_give_different_episodes() -> None:
    env = make("RememberColor9-v0")
    env.reset(seed=[1])
    layouts = []
    for _ in range(3):
        env.reset()
        layouts.append(env._slots.copy())
    assert not np.array_equal(layouts[0], layouts[1])
    assert not np.array_equal(layouts[1], layouts[2])


def test_the_same_seeds_have_independent_answers_in_different_tasks() -> None:
    """Or the luck of a blind arm would repeat from task to task."""

    def answers(task: str) -> list[int]:
        env = make(task)
        found = []
        for seed in range(1, 25):
            env.reset(seed=[seed])
            found.append(int(env.target_index()[0]))
        return found

    three, shells = answers("RememberColor3-v0"), answers("ShellGameTouch-v0")
    # Independent uniform answers agree in 8 ± 2.3 of 24 episodes; the bound is five deviations away.
    assert sum(a == b for a, b in zip(three, shells, strict=True)) < 20
    assert set(three) == set(shells) == {0, 1, 2}


def test_infos_of_earlier_steps_keep_their_values() -> None:
    env = make("RememberColor3-v0")
    _, early = env.reset(seed=[1])
    env.step(env.hold_action())
    assert int(early["elapsed_steps"][0]) == 0


@pytest.mark.sampled(3)
def test_success_and_states_do_not_depend_on_the_reward_mode(sampled_task: str) -> None:
    outcomes = []
    for mode in ("dense", "normalized_dense", "sparse", "none"):
        env = make(sampled_task, reward_mode=mode)
        env.reset(seed=[4])
        rows = []
        for action in pressing_actions(4, 15):
            _, reward, *_, info = env.step(action)
            assert torch.isfinite(reward).all()
            assert float(reward) <= (1.0 if mode == "normalized_dense" else env.unwrapped.MAX_REWARD)
            rows.append((bool(info["success"][0]), env.get_state()[0].numpy().tobytes()))
        outcomes.append(rows)
    assert all(rows == outcomes[0] for rows in outcomes)


def go_to(env: Any, goal: FloatArray, n_steps: int) -> Any:
    """Move the tool centre point to (3,) and return the last info."""
    info = None
    for _ in range(n_steps):
        action = np.zeros((1, 7), dtype=np.float32)
        action[0, :3] = (13 * (goal - env.tcp_position_m()[0])).clip(-1, 1)
        action[0, 6] = 1
        *_, info = env.step(action)
    return info


def test_touching_the_cue_counts_only_without_the_phase_gate() -> None:
    above_cue = np.array([0.0, 0.0, 0.06])
    gated = make("RememberColor3-v0", cue_steps=30)
    gated.reset(seed=[1])
    assert not bool(go_to(gated, above_cue, 25)["success"][0])
    official = make("RememberColor3-v0", cue_steps=30, phase_gate_success=False)
    official.reset(seed=[1])
    assert bool(go_to(official, above_cue, 25)["success"][0])


def test_first_choice_is_latched_and_wrong_ones_are_counted() -> None:
    env = make("RememberColor3-v0", cue_steps=1, delay_steps=0)
    env.reset(seed=[2])
    target = int(env.target_index()[0])
    wrong = (target + 1) % 3
    lift = np.array([0.0, 0.0, 0.04])
    info = go_to(env, env._slots[0, wrong] + lift, 25)
    assert (int(info["first_choice"][0]), int(info["n_wrong_choices"][0])) == (wrong, 1)
    assert not bool(info["success"][0])
    info = go_to(env, env._slots[0, target] + lift, 25)
    assert (int(info["first_choice"][0]), int(info["n_wrong_choices"][0])) == (wrong, 1)
    assert bool(info["success"][0])


def test_strict_choice_makes_the_first_wrong_touch_a_failure_for_good() -> None:
    env = make("RememberColor3-v0", cue_steps=1, delay_steps=0, strict_choice=True)
    env.reset(seed=[2])
    target = int(env.target_index()[0])
    lift = np.array([0.0, 0.0, 0.04])
    assert bool(go_to(env, env._slots[0, (target + 1) % 3] + lift, 25)["fail"][0])
    info = go_to(env, env._slots[0, target] + lift, 25)
    assert bool(info["fail"][0])
    assert not bool(info["success"][0])


@pytest.mark.parametrize(
    "task",
    ["RememberShape3-v0", "BunchOfColors3-v0", "SeqOfColors3-v0", "ShellGameTouch-v0", "ShellGamePush-v0"],
)
def test_without_its_cue_an_episode_shows_nothing_before_the_choice_and_is_otherwise_the_same(
    task: str,
) -> None:
    episodes = []
    for show_cue in (True, False):
        env = make(task, show_cue=show_cue)
        env.reset(seed=[4])
        states = []
        for _ in range(int(env._response_step[0]) + 2):
            is_response = bool(env.response_begun()[0])
            shown = list(visible(env))
            ball = getattr(env, "ball", None)
            if ball is not None and float(ball.pose.p[0, 0]) < PARK_X_M - 1:
                shown.append(-1)
            states.append((is_response, shown, env.get_state()[0].numpy().copy()))
            env.step(np.zeros(7, dtype=np.float32))
        episodes.append(states)
        env.close()
    usual, without = episodes
    assert any(shown for is_response, shown, _ in usual if not is_response)
    assert not any(shown for is_response, shown, _ in without if not is_response)
    for (is_response, shown, state), (_, same, other) in zip(usual, without, strict=True):
        if is_response:
            assert shown == same
            np.testing.assert_array_equal(state, other)


def test_freeze_until_choice_holds_arm_and_gripper() -> None:
    env = make("RememberColor3-v0", freeze_until_choice=True)
    env.reset(seed=[1])
    start = env.agent.robot.get_qpos().clone()
    moved = np.ones(7, dtype=np.float32)
    moved[6] = -1  # close the gripper: must not be carried out either
    for _ in range(9):
        env.step(moved)
    assert torch.allclose(env.agent.robot.get_qpos(), start, atol=2e-3)
    # What is recorded is what was carried out: no motion, fingers 4 cm from the middle, fully open.
    assert np.allclose(env.executed_action[0], np.array([0.0] * 6 + [1.0]), atol=1e-2)
    for _ in range(5):
        env.step(moved)
    assert not torch.allclose(env.agent.robot.get_qpos(), start, atol=2e-2)


def test_phase_lengths_are_drawn_from_their_ranges_by_the_seed_alone() -> None:
    env = make("RememberColor3-v0", cue_steps=(1, 5), delay_steps=(0, 3))
    drawn = {}
    for seed in range(1, 31):
        _, info = env.reset(seed=[seed])
        drawn[seed] = (int(info["cue_steps"][0]), int(info["delay_steps"][0]))
    assert {cue for cue, _ in drawn.values()} == {1, 2, 3, 4, 5}
    assert {delay for _, delay in drawn.values()} == {0, 1, 2, 3}
    _, info = env.reset(seed=[7])
    assert (int(info["cue_steps"][0]), int(info["delay_steps"][0])) == drawn[7]


def test_official_shell_state_keeps_a_unit_quaternion() -> None:
    env = make("ShellGameTouch-v0")
    env.reset(seed=[1])
    quaternion = env.candidates[0].pose.q[0]
    assert float(torch.linalg.norm(quaternion)) == pytest.approx(1, abs=1e-5)
