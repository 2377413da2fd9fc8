"""Everyday things beside a task: nothing else of the episode knows of them, and touching one is no choice."""

import re
from typing import Any

import numpy as np
import pytest
import sapien

from tests.tasks.made_tasks import make
from tests.tasks.sample import SAMPLE
from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import describe_env, make_env
from vla_eval.errors import TaskArgumentError, UnknownNameError
from vla_eval.tasks.choice import NO_CHOICE
from vla_eval.tasks.memory_env import PARK_X_M, MemoryTableEnv
from vla_eval.tasks.objects.bodies import pose_of
from vla_eval.tasks.objects.free_places import drawn_poses, used_areas

SEED = 5
SWAPPED = ("RememberObject5-v0", "BunchOfColors3-v0", "ShellGamePick-v0", "TakeItBack-v0")
FURNITURE = ("table-workspace", "ground")
HUGE_PEG = {"peg_half_length_m": 0.5, "peg_half_width_m": 0.5}
CAMERAS = ("base_camera", "hand_camera")
IN_VIEW = [pytest.param(task, marks=() if task == SAMPLE[0] else pytest.mark.slow) for task in SAMPLE]


def most(task: str) -> int:
    """How many things the task takes, as its refusal of more says."""
    try:
        make(task, clutter=12)
    except TaskArgumentError as exc:
        found = re.search(r"at most (\d+)", str(exc))
        assert found is not None
        return int(found[1])
    return 12


def things_of(env: Any) -> list[np.ndarray]:
    return [pose_of(actor)[0].copy() for actor in env._clutter._actors]


def others_of(env: Any) -> dict[str, np.ndarray]:
    """Where everything is that is no thing, and how fast: bodies by name, and the robot's joints."""
    things = {actor.name for actor in env._clutter._actors}
    bodies = {name: actor for name, actor in env.scene.actors.items() if name not in things}
    found = {name: pose_of(actor)[0].copy() for name, actor in bodies.items()}
    return {**found, "qpos": env.qpos()[0].copy(), "qvel": env.qvel()[0].copy()}


def episode(task: str, n_steps: int, *, seed: int = SEED, **kwargs: Any) -> list[tuple[Any, Any]]:
    """Poses of the things, and of all else, at each step while the arm does the same."""
    env = make(task, **kwargs)
    env.reset(seed=[seed])
    seen = [(things_of(env), others_of(env))]
    for step in range(n_steps):
        env.step(np.array([0.3, (-1) ** step * 0.4, -0.2, 0, 0, 0, 1], dtype=np.float32))
        seen.append((things_of(env), others_of(env)))
    env.close()
    return seen


@pytest.mark.parametrize("task", SAMPLE)
def test_more_things_change_nothing_but_what_is_added(task: str) -> None:
    n = most(task)
    assert n >= 3
    worlds = [episode(task, 12, clutter=count) for count in (0, n - 1, n)]
    for without, fewer, more in zip(*worlds, strict=True):
        for count, (things, others) in zip((0, n - 1, n), (without, fewer, more), strict=True):
            assert len(things) == count
            for name, state in others.items():
                np.testing.assert_array_equal(state, without[1][name], err_msg=name)
        np.testing.assert_array_equal(fewer[0], more[0][: n - 1])


@pytest.mark.parametrize("task", SWAPPED)
def test_things_stand_where_they_stand_whatever_the_cue(task: str) -> None:
    drawn, swapped = (episode(task, 2, clutter=3, swap_cue=swap) for swap in (0, 1))
    for (one, _), (other, _) in zip(drawn, swapped, strict=True):
        np.testing.assert_array_equal(one, other)


def test_where_things_stand_depends_on_the_seed_alone() -> None:
    (alone, _), *_ = episode("RememberColor3-v0", 0, seed=7, clutter=4)
    env = make("RememberColor3-v0", clutter=4, reconfiguration_freq=0)  # in one scene, after others
    for seed in (3, 9, 7):
        env.reset(seed=[seed])
        placed = things_of(env)
        assert np.array_equal(placed, alone) == (seed == 7)
    (other_task, _), *_ = episode("RememberColor5-v0", 0, seed=7, clutter=4)
    assert not np.array_equal(alone, other_task)


@pytest.mark.parametrize("task", SAMPLE)
def test_all_that_a_task_places_is_within_the_areas_that_it_says_it_uses(task: str) -> None:
    env = make(task, clutter=1)
    for seed in range(1, 7):
        env.reset(seed=[seed])
        points = [place[:2] for place in (env.cue_places_m(0) if hasattr(env, "candidates") else [])]
        if hasattr(env, "candidates"):
            points += env._slots[0, :, :2].tolist()
        placed = {name: pose[:2] for name, pose in others_of(env).items() if name not in FURNITURE}
        bodies = [xy for name, xy in placed.items() if not name.startswith("q") and xy[0] < PARK_X_M - 1]
        for point in (*points, *bodies):
            assert min(area.distance_m(np.array(point)) for area in env.used_areas()) < -0.02, point
    env.close()


@pytest.mark.parametrize("task", ["RememberColor9-v0", "ShellGameTouch-v0"])
def test_a_hand_that_rests_on_a_thing_has_made_no_choice(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make(task, clutter=12, strict_choice=True)
    env.reset(seed=[SEED])
    while not env.response_begun()[0]:
        env.step(env.hold_action())
    monkeypatch.setattr(env, "is_static", lambda: np.array([True]))
    for thing in things_of(env):
        monkeypatch.setattr(env, "tcp_position_m", lambda place=thing: place[None, :3])
        env._update_latches(env.step_count())
        info = env.read_info()
        assert info["first_choice"][0] == NO_CHOICE and env.touched_candidates(0) == ()
        assert not info["success"][0] and not info["fail"][0]
    monkeypatch.setattr(env, "tcp_position_m", lambda: env.touch_points_m()[:, 1])
    env._update_latches(env.step_count())
    assert env.read_info()["first_choice"][0] == 1


def n_pixels(task: str, clutter: int, *, seed: int) -> list[dict[str, int]]:
    """Pixels of the base camera that each body covers: at the start, and when the choice has appeared."""
    env = make_env(EnvSettings(task=task, kwargs={"clutter": clutter}, cameras=CAMERAS))
    env.reset({0: seed}, render=False)
    (inner,), seen = env._envs, []
    for step in range(int(inner._response_step[0]) + 1):
        if step in (0, inner._response_step[0]):
            inner.scene.update_render(update_sensors=True, update_human_render_cameras=False)
            camera = inner.scene.sensors["base_camera"]
            camera.capture()
            image = camera.get_obs(rgb=False, depth=False, position=False, segmentation=True)["segmentation"]
            counts = np.bincount(image.numpy().ravel())
            numbers = {name: int(actor.per_scene_id[0]) for name, actor in inner.scene.actors.items()}
            seen.append({name: int(counts[n]) if n < len(counts) else 0 for name, n in numbers.items()})
        env.step({0: env.hold_action(0)}, render=frozenset())
    env.close()
    return seen


@pytest.mark.parametrize("task", IN_VIEW)
def test_all_things_are_seen_and_hide_not_a_pixel_of_the_cue_and_the_candidates(task: str) -> None:
    n = most(task)
    without, among = n_pixels(task, 0, seed=SEED), n_pixels(task, n, seed=SEED)
    for one, other in zip(without, among, strict=True):
        of_task = one.keys() - FURNITURE
        assert {name: one[name] for name in of_task} == {name: other[name] for name in of_task}
        assert any(one[name] for name in of_task)
    things = among[0].keys() - without[0].keys()
    assert len(things) == n and all(among[0][name] > 0 for name in things)


def test_an_arm_that_runs_into_a_thing_is_stopped_and_moves_it_not() -> None:
    env = make("RememberColor3-v0", clutter=1)
    env.reset(seed=[SEED])
    (actor,) = env._clutter._actors
    place = pose_of(actor)[0].copy()
    above = sapien.Pose(p=[*place[:2], 0.3])
    env.move(env.candidates[0], np.array([True]), above)  # falls onto it
    for _ in range(20):
        env.step(env.hold_action())
    np.testing.assert_array_equal(pose_of(actor)[0], place)
    fallen = env.candidate_positions_m()[0, 0]
    assert fallen[2] < 0.2 and np.linalg.norm(fallen - place[:3]) > 0.02
    env.close()


@pytest.mark.parametrize(
    ("task", "kwargs", "message"),
    [
        ("RememberObject9-v0", {"clutter": 4}, "clutter=4: expected at most 3: the other everyday things"),
        ("RememberObject", {"n_items": 12, "clutter": 1}, "clutter=1: expected at most 0"),
        ("InterceptMedium-v0", {"clutter": 9}, "clutter=9: expected at most 8: no more places"),
        ("RotateLenientPos-v0", HUGE_PEG | {"clutter": 1}, "clutter=1: expected at most 0: no more places"),
        ("RememberColor3-v0", {"clutter": 13}, "clutter=13: expected 0 to 12"),
        ("RememberColor3-v0", {"clutter": -1}, "clutter=-1: expected 0 to 12"),
        ("RememberColor3-v0", {"clutter": True}, "clutter"),
        ("mikasa_vla/RememberColor3-VLA-v0", {"clutter": 1}, "no argument 'clutter'"),
        ("mikasa_base/MemoryLengthHard-v0", {"clutter": 1}, "no argument 'clutter'"),
    ],
)
def test_things_that_do_not_fit_are_refused_before_anything_starts(
    task: str, kwargs: dict[str, Any], message: str
) -> None:
    with pytest.raises((TaskArgumentError, UnknownNameError), match=re.escape(message)):
        describe_env(EnvSettings(task=task, kwargs=kwargs))


def test_a_class_that_does_not_say_what_it_uses_takes_no_things() -> None:
    class Other(MemoryTableEnv):
        def n_swaps(self) -> int:
            return 0

    with pytest.raises(TaskArgumentError, match=r"Other has no method `used_areas`. Define it"):
        Other(clutter=1)


def test_every_task_says_which_areas_it_uses() -> None:
    with pytest.raises(AssertionError, match="no task has only these arguments: a"):
        used_areas(a=1)


def test_in_a_batch_each_episode_has_its_own_places() -> None:
    env = make("RememberColor3-v0", clutter=3)
    env.reset(seed=[SEED])
    seeds, mask = (7, 8, 9), np.array([True, False, True])
    drawn = env._clutter.drawn(mask, lambda row: np.random.default_rng(seeds[row]))
    for index, (_, poses) in enumerate(drawn):
        for row in (0, 2):
            rng = np.random.default_rng(seeds[row])
            x, y, _ = drawn_poses(env._clutter_places_m, rng)[index]
            np.testing.assert_allclose(poses[row, :2], (x, y), rtol=1e-6)
            assert np.linalg.norm(poses[row, 3:]) == pytest.approx(1)
    assert index == 2
    env.close()
