"""A swapped cue: another right answer, and nothing else is different until the robot acts on it."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.tasks.made_tasks import make
from vla_eval.config.environment import EnvSettings, RenderSettings
from vla_eval.envs.factory import make_env
from vla_eval.errors import TaskArgumentError
from vla_eval.tasks.catalog import TASKS, task_spec
from vla_eval.tasks.families import FAMILY_TABLE
from vla_eval.tasks.memory_env import MemoryTableEnv
from vla_eval.tasks.register import env_class
from vla_eval.tasks.remember import RememberShapeEnv

CHOICES = {"RememberShapeAndColor5x3-v0": 15, "ShellGameTouch-v0": 3}
"""Task -> number of candidates."""
SEED = 2
# The cubes of Seq are drawn and shown by the code of Chain.
SLOW_SEQ = pytest.param("SeqOfColors3-v0", marks=pytest.mark.slow)


def bodies(env: Any) -> np.ndarray:
    """The robot, and where the candidates are and how they move, as one vector."""
    parts = [env.agent.robot.get_qpos(), env.agent.robot.get_qvel()]
    for actor in env.candidates:
        parts += [actor.pose.raw_pose, actor.linear_velocity, actor.angular_velocity]
    return np.concatenate([part[0].numpy() for part in parts])


def held(task: str, n_after: int = 4, **kwargs: Any) -> tuple[list[np.ndarray], tuple[int, ...], int]:
    """The bodies at each step while the robot holds, the right candidates, and where the response begins."""
    env = make(task, **kwargs)
    env.reset(seed=[SEED])
    response_step = int(env._response_step[0])
    states = [bodies(env)]
    for _ in range(response_step + n_after):
        env.step(env.hold_action())
        states.append(bodies(env))
    right = env.right_candidates(0)
    env.close()
    return states, right, response_step


@pytest.mark.parametrize(
    "task", ["RememberShape9-v0", "RememberObject9-v0", "BunchOfColors3-v0", "ShellGameTouch-v0"]
)
def test_the_other_cue_moves_no_body_by_a_bit(task: str) -> None:
    """In the first two, an item that has been shown would settle in another way than one that has not."""
    drawn, right, response_step = held(task)
    swapped, other, _ = held(task, swap_cue=1)
    assert other != right
    assert len(drawn) == response_step + 5
    for step, (one, two) in enumerate(zip(drawn, swapped, strict=True)):
        np.testing.assert_array_equal(one, two, err_msg=f"step {step}")


@pytest.mark.parametrize("task", CHOICES)
def test_each_swap_of_a_choice_shows_another_candidate(task: str) -> None:
    n_candidates = CHOICES[task]
    right = []
    for swap in {0, 1, n_candidates - 1}:
        env = make(task, swap_cue=swap)
        env.reset(seed=[SEED])
        right.append(int(env.target_index()[0]))
        env.close()
    assert len(set(right)) == 3
    with pytest.raises(TaskArgumentError, match=f"swap_cue={n_candidates}: expected 0 to {n_candidates - 1}"):
        make(task, swap_cue=n_candidates)


def shown_in_turn(**kwargs: Any) -> tuple[int, ...]:
    env = make(**kwargs)
    env.reset(seed=[SEED])
    shown: tuple[int, ...] = env.right_candidates(0)
    env.close()
    return shown


@pytest.mark.parametrize("task", ["BunchOfColors3-v0", SLOW_SEQ, "ChainOfColors3-v0"])
def test_a_swapped_set_has_one_other_cube(task: str) -> None:
    first, *rest = shown_in_turn(task=task)
    for swap in (1, 6)[: 2 if task.startswith("Bunch") else 1]:
        other, *same = shown_in_turn(task=task, swap_cue=swap)
        assert same == rest
        assert other not in (first, *rest)
    with pytest.raises(TaskArgumentError, match="expected 0 to 6"):  # 9 cubes, 3 of them shown
        make(task, swap_cue=7)


@pytest.mark.parametrize("task", [SLOW_SEQ, "ChainOfColors3-v0"])
def test_a_swapped_order_exchanges_two_cubes(task: str) -> None:
    first, second, third = shown_in_turn(task=task)
    assert shown_in_turn(task=task, swap_order=1) == (second, first, third)
    assert shown_in_turn(task=task, swap_order=2) == (third, second, first)
    drawn, _, _ = held(task, n_after=5)
    swapped, _, _ = held(task, n_after=5, swap_order=2)
    np.testing.assert_array_equal(drawn, swapped)


def test_cubes_that_are_shown_together_have_no_order_and_all_of_them_no_other_set() -> None:
    with pytest.raises(TaskArgumentError, match="swap_order=1: expected 0 to 0"):
        make("BunchOfColors3-v0", swap_order=1)
    with pytest.raises(TaskArgumentError, match="swap_cue=1: expected 0 to 0, as the cue has no other value"):
        make("BunchOfColors3-v0", n_items=3, swap_cue=1)


@pytest.mark.parametrize("task", ["InterceptMedium-v0", "InterceptGrabSlow-v0"])
def test_a_swapped_ball_differs_in_its_speed_alone(task: str) -> None:
    worlds = []
    for swap in (0, 1):
        env = make(task, swap_cue=swap)
        env.reset(seed=[SEED])
        worlds.append(env)
    drawn, swapped = worlds
    least, most = drawn.velocity_range_m_s
    (x, y, z), (other_x, other_y, other_z) = (env._initial_velocity[0].tolist() for env in worlds)
    assert (other_x, other_z) == (x, z)
    assert least <= other_y <= most
    assert abs(other_y - y) == pytest.approx((most - least) / 2)
    np.testing.assert_array_equal(drawn.ball.pose.raw_pose, swapped.ball.pose.raw_pose)
    np.testing.assert_array_equal(drawn.agent.robot.get_qpos(), swapped.agent.robot.get_qpos())
    if task.startswith("InterceptM"):
        np.testing.assert_array_equal(drawn.goal.pose.raw_pose, swapped.goal.pose.raw_pose)


@pytest.mark.parametrize(
    ("task", "kwargs"),
    [
        ("RotateLenientPos-v0", {}),
        ("RotateStrictPosNeg-v0", {}),
        ("RotateStrictPosNeg-v0", {"official_signs": True}),
    ],
)
def test_a_swapped_angle_is_right_for_no_peg_that_is_right_for_the_drawn_one(
    task: str, kwargs: dict[str, Any]
) -> None:
    drawn, swapped = make(task, **kwargs), make(task, swap_cue=1, **kwargs)
    least, most = drawn.angle_range_rad
    for seed in range(1, 4):
        for env in (drawn, swapped):
            env.reset(seed=[seed])
        one, other = float(drawn.prompt()[0, 0]), float(swapped.prompt()[0, 0])
        assert least <= abs(other) <= most
        assert abs(one - other) >= 2 * drawn.angle_threshold_rad
        if drawn.signed:
            assert one * other < 0
        np.testing.assert_array_equal(drawn.get_state(), swapped.get_state())


def test_angles_that_are_not_apart_have_no_swap() -> None:
    # Half of the range is 0.15 rad; the tolerances of 0.1 rad on either side would overlap.
    with pytest.raises(TaskArgumentError, match="swap_cue=1: expected 0 to 0"):
        make("RotateLenientPos-v0", angle_range_rad=(0.1, 0.4), swap_cue=1)


def test_a_swapped_cube_begins_in_another_band_and_returns_there() -> None:
    places = []
    for swap in (0, 1, 2):
        env = make("TakeItBack-v0", swap_cue=swap)
        env.reset(seed=[SEED])
        (x, y, _), goal = env.oracle_info()[0].tolist(), env._goal_position[0].tolist()
        places.append((x, y, goal, env.agent.robot.get_qpos()[0].tolist()))
        assert env.cube.pose.p[0, 1] == pytest.approx(y)
    bands = sorted(y for _, y, *_ in places)
    assert np.diff(bands) == pytest.approx([0.1, 0.1])
    assert places[0][0] == places[1][0] == places[2][0]
    assert places[0][2:] == places[1][2:] == places[2][2:]


def test_the_handles_of_the_mugs_stay_with_the_drawn_ball() -> None:
    """The scene is that of the drawn cue, so reading the handles does not follow the other cue."""
    states = []
    for swap in (0, 1):
        env = make("ShellGamePick-v0", official_mug_yaws=True, swap_cue=swap)
        env.reset(seed=[SEED])
        for _ in range(6):
            env.step(env.hold_action())
        states.append(bodies(env))
    np.testing.assert_array_equal(*states)


def frames(task: str, n: int, **kwargs: Any) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """The phase and the images of each step while the robot holds; cue and delay have two steps each."""
    env = make_env(
        EnvSettings(
            task=task,
            kwargs={"cue_steps": 2, "delay_steps": 2, **kwargs},
            cameras=("base_camera", "hand_camera"),
            render=RenderSettings(wrist_mesh="simplified"),
        )
    )
    result = env.reset({0: SEED}, render=True)[0]
    for _ in range(n):
        yield result.status.phase, dict(result.observation.images)
        result = env.step({0: env.hold_action(0)}, render=frozenset({0}))[0]
    env.close()


@pytest.mark.parametrize("task", ["RememberShape3-v0", "ShellGameTouch-v0"])
def test_only_the_frames_of_the_cue_differ(task: str) -> None:
    phases = set()
    drawn, swapped = frames(task, 6), frames(task, 6, swap_cue=1)
    for (phase, one), (_, other) in zip(drawn, swapped, strict=True):
        phases.add(phase)
        is_same = all(np.array_equal(one[name], other[name]) for name in one)
        assert is_same == (phase != "cue"), phase
    assert phases == {"cue", "delay", "response"}


def test_a_decoy_has_the_pixels_of_the_item(monkeypatch: pytest.MonkeyPatch) -> None:
    with_decoys = [images for _, images in frames("RememberShape3-v0", 2, swap_cue=1)]
    monkeypatch.setattr(RememberShapeEnv, "is_swapped", lambda self: False)  # as on the GPU: no decoys
    with_items = [images for _, images in frames("RememberShape3-v0", 2, swap_cue=1)]
    for one, other in zip(with_decoys, with_items, strict=True):
        for name, image in one.items():
            np.testing.assert_array_equal(image, other[name])


def test_every_family_has_a_swap() -> None:
    for family in FAMILY_TABLE:
        assert env_class(task_spec(family.row)).n_swaps is not MemoryTableEnv.n_swaps, family.id


def test_every_task_of_the_catalogue_can_be_swapped_on_the_fake_simulator() -> None:
    for task in TASKS:
        worlds = []
        for swap in (0, 1):
            env = make_env(
                EnvSettings(task=task, kwargs={"swap_cue": swap}, simulator="fake", privileged=True)
            )
            worlds.append(env.reset({0: SEED}, render=False)[0].observation)
        one, other = (world.privileged for world in worlds)
        assert one is not None and other is not None
        np.testing.assert_array_equal(worlds[0].state["qpos"], worlds[1].state["qpos"])
        np.testing.assert_array_equal(one.candidate_positions_m, other.candidate_positions_m)
        if TASKS[task].candidates:
            assert set(one.right_candidates) != set(other.right_candidates)
        else:
            assert one.bodies["ball"].velocity_m_s[1] != other.bodies["ball"].velocity_m_s[1]
