"""Memory Maze: the levels and the first steps of the original, and what must not change an episode."""

import hashlib
import importlib.util
import multiprocessing
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from tests.base_tasks.golden_episodes import GoldenEpisode, golden_episodes
from vla_eval.base_tasks import headless, memory_maze
from vla_eval.base_tasks.make import make_base_task
from vla_eval.base_tasks.players.memory_maze import FORWARD, LEFT, shortest_way, steering
from vla_eval.base_tasks.players.play import player_of
from vla_eval.errors import MissingDependencyError

for package in memory_maze.PACKAGES:
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed: `make base`, on Python 3.12", allow_module_level=True)
try:
    headless.available_renderer()
except MissingDependencyError as exc:
    pytest.skip(str(exc), allow_module_level=True)

SMALL = "MemoryMaze-9x9-v0"
SIZES = [SMALL, *(f"MemoryMaze-{n}x{n}-v0" for n in (11, 13, 15))]
N_EQUAL_STEPS = 10  # later, rounding of other versions of MuJoCo shows


def _first_episodes(name: str) -> list[GoldenEpisode]:
    return list(golden_episodes(name))


@pytest.mark.parametrize(
    "name", [SMALL, *(pytest.param(n, marks=pytest.mark.slow) for n in SIZES[1:3]), SIZES[3]]
)
def test_a_seed_gives_the_level_and_the_first_steps_of_the_original(name: str) -> None:
    env = make_base_task(name)
    episodes = _first_episodes(name)
    assert {episode.seed for episode in episodes} == {0, 1, 2}
    for episode in episodes:
        env.reset(seed=episode.seed)
        state = env.true_state()
        assert np.array_equal(state["maze_layout"], episode.level["maze_layout"])
        for key in ("targets_pos", "agent_pos", "agent_dir"):
            np.testing.assert_allclose(state[key], episode.level[key], atol=1e-9)
        places = [state["agent_pos"]]
        for step in range(N_EQUAL_STEPS):
            _, reward, terminated, truncated, _ = env.step(episode.actions[step])
            assert (reward, terminated, truncated) == (episode.rewards[step], False, False)
            places.append(env.true_state()["agent_pos"])
        np.testing.assert_allclose(places, episode.fields["agent_pos"][: N_EQUAL_STEPS + 1], atol=1e-4)
    env.close()


def test_a_target_in_the_middle_counts_as_touched_in_the_first_step_as_in_the_original() -> None:
    env = make_base_task(SMALL)
    # The original, run with these seeds: reward and next target of the first step.
    for seed, next_place in ((68, (6.5, 8.5)), (152, (0.5, 8.5))):
        env.reset(seed=seed)
        state = env.true_state()
        assert state["targets_pos"][int(state["target"])].tolist() == [4.5, 4.5]
        assert np.linalg.norm(state["agent_pos"] - 4.5) > 1
        assert env.step(0)[1] == 1.0 and env.step(0)[1] == 0.0
        state = env.true_state()
        assert tuple(state["targets_pos"][int(state["target"])]) == next_place
    env.close()


def test_an_episode_is_truncated_at_its_horizon_and_has_no_success() -> None:
    env = make_base_task(SMALL, horizon_steps=3)
    env.reset(seed=0)
    assert [env.step(0)[2:] for _ in range(3)] == [(False, False, {}), (False, False, {}), (False, True, {})]
    env.close()


def test_seeds_beyond_those_of_the_original_and_none_give_levels_too() -> None:
    env = make_base_task(SMALL)
    layouts = []
    for seed in (2**40, 2**40, None):
        env.reset(seed=seed)
        layouts.append(env.true_state()["maze_layout"])
    assert np.array_equal(layouts[0], layouts[1]) and not np.array_equal(layouts[1], layouts[2])
    env.close()


def _digest(seed: int, *, is_drawn: bool = False) -> str:
    """Return a digest of an episode of 12 steps: images, rewards, poses."""
    env = make_base_task(SMALL, render_mode="rgb_array")
    observation, _ = env.reset(seed=seed)
    digest = hashlib.sha256(observation.tobytes())
    for step in range(12):
        if is_drawn:
            env.render()
        observation, reward, *_ = env.step((1, 4, 1, 5)[step % 4])
        state = env.true_state()
        for part in (observation, reward, state["agent_pos"], state["agent_dir"], state["target"]):
            digest.update(np.asarray(part).tobytes())
    env.close()
    return digest.hexdigest()


OTHER_PROCESS = f"""
import hashlib
from vla_eval.base_tasks.make import make_base_task
env = make_base_task("{SMALL}")
env.reset(seed=4)
observation, _ = env.reset(seed=5)
digest = hashlib.sha256(observation.tobytes())
for step in range(12):
    digest.update(env.step((1, 4, 1, 5)[step % 4])[0].tobytes())
print(digest.hexdigest())
"""


@pytest.mark.slow
def test_two_processes_give_the_same_episode_and_print_nothing() -> None:
    env = make_base_task(SMALL)
    observation, _ = env.reset(seed=5)
    digest = hashlib.sha256(observation.tobytes())
    for step in range(12):
        digest.update(env.step((1, 4, 1, 5)[step % 4])[0].tobytes())
    env.close()
    other = subprocess.run([sys.executable, "-c", OTHER_PROCESS], capture_output=True, text=True, check=True)
    assert (other.stdout, other.stderr) == (f"{digest.hexdigest()}\n", "")


def test_an_episode_is_the_same_after_a_fork() -> None:
    here = _digest(6)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(_digest, (6,)).get(timeout=120) == here


def test_pictures_change_nothing_of_an_episode() -> None:
    assert _digest(7, is_drawn=True) == _digest(7)


def test_the_border_has_the_colour_of_the_prompted_target() -> None:
    env = make_base_task(SMALL)
    for seed in range(3):
        image, _ = env.reset(seed=seed)
        color = (memory_maze.COLORS[int(env.true_state()["target"])] * 255 * 0.7).astype(np.uint8)
        border = np.ones((64, 64), bool)
        border[2:-2, 2:-2] = False
        assert (image[border] == color).all() and (image[~border] != color).any()
    env.close()


def _play(
    env: Any, player: Any, seed: int, n_steps: int
) -> list[tuple[float, dict[str, Any], dict[str, Any]]]:
    """Return reward, state before and state after of each step."""
    observation, _ = env.reset(seed=seed)
    player.begin(np.random.default_rng(0))
    steps, state = [], env.true_state()
    for _ in range(n_steps):
        observation, reward, *_ = env.step(player.act(observation, state))
        steps.append((reward, state, env.true_state()))
        state = steps[-1][2]
    return steps


def test_only_the_prompted_target_is_rewarded_and_then_another_one_is_prompted() -> None:
    env = make_base_task(SMALL)
    steps = _play(env, player_of(SMALL, "oracle", env.action_space), seed=1, n_steps=150)
    assert sum(reward for reward, *_ in steps) >= 3
    for reward, before, after in steps:
        changed = int(before["target"]) != int(after["target"])
        assert changed == bool(reward)
        if reward:
            prompted = before["targets_pos"][int(before["target"])]
            assert np.linalg.norm(after["agent_pos"] - prompted) < 0.4 + 0.3  # half a metre on at most
    env.close()


def test_the_renderer_that_the_user_names_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with headless.renderer_chosen():
        assert os.environ["MUJOCO_GL"] == "osmesa"


def test_what_to_install_is_said_where_nothing_can_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(headless, "RENDERERS", (("egl", "libNoEGL.so.1"), ("osmesa", "libNoMesa.so.8")))
    with (
        pytest.raises(MissingDependencyError, match=r"apt-get install libegl1.*libosmesa6"),
        headless.renderer_chosen(),
    ):
        pass


@pytest.mark.parametrize("setting", ["off", "bogus"])
def test_a_renderer_that_does_not_start_is_one_error(setting: str) -> None:
    code = f"from vla_eval.base_tasks.make import make_base_task; make_base_task('{SMALL}').reset(seed=0)"
    environment = {**os.environ, "MUJOCO_GL": setting}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    last = done.stderr.splitlines()[-1]
    assert last.startswith(
        f"vla_eval.errors.RenderingError: The renderer does not start (MUJOCO_GL={setting})"
    )


@pytest.mark.parametrize(("wheels", "message"), [((3, 11), "needs Python 3.12"), ((3, 13), "`make base`")])
def test_what_is_missing_is_said(
    monkeypatch: pytest.MonkeyPatch, wheels: tuple[int, int], message: str
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "labmaze" else found(name))
    monkeypatch.setattr(memory_maze, "LABMAZE_UP_TO", wheels)
    with pytest.raises(MissingDependencyError, match=message):
        make_base_task(SMALL)


def test_the_way_of_the_oracle() -> None:
    layout = np.array([[1, 1, 1], [0, 0, 1], [1, 1, 1]], np.uint8)
    assert shortest_way(layout, (0, 0), (2, 0)) == [(0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0)]
    north, west = np.array([0.0, 1.0]), np.array([-1.0, 0.0])
    assert steering(north, north) == FORWARD and steering(north, west) == LEFT
