"""What every MIKASA-Base environment promises, whatever its rules are."""

import random
import warnings
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import vla_eval.base_tasks.register  # noqa: F401
from vla_eval.base_tasks.catalog import BASE_TASKS, base_task
from vla_eval.base_tasks.make import make_base_task
from vla_eval.base_tasks.players.play import Kind, player_of
from vla_eval.base_tasks.row import Figures
from vla_eval.errors import InvalidActionError, TaskArgumentError, UnknownNameError

pytestmark = pytest.mark.skipif(find_spec("popgym") is None, reason="needs `make base`")

FIRST = {row.family: name for name, row in reversed(BASE_TASKS.items())}
IN_3D = {"ViZDoom": "vizdoom", "MemoryMaze": "labmaze"}
N_MAZE_STEPS = 40  # drawn by a renderer


def _is_maze(name: str) -> bool:
    return name.startswith("MemoryMaze")


def _param(name: str) -> Any:
    packages = [package for prefix, package in IN_3D.items() if name.startswith(prefix)]
    missing = [package for package in packages if find_spec(package) is None]
    marks = [pytest.mark.skipif(bool(missing), reason=f"{', '.join(missing)} is missing: `make base`")]
    return pytest.param(name, marks=marks if name in FIRST.values() else [*marks, pytest.mark.slow])


IDS = [_param(name) for name in sorted(BASE_TASKS)]
"""Every level; in a quick run the first of each family."""
IDS_FLAT = [
    pytest.param(name, marks=pytest.mark.slow) if name.startswith(tuple(IN_3D)) else _param(name)
    for name in sorted(BASE_TASKS)
]
"""For claims that take long in 3D; their own tests make them on shorter episodes."""
ANSWERS = ("counts", "bandits", "maze", "is_red", "level", "target", "position")


def _random_episode(env: Any, seed: int, n_steps: int = 60) -> list[Any]:
    rng = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    seen: list[Any] = [observation, info]
    for _ in range(n_steps):
        env.action_space.seed(int(rng.integers(2**31)))
        result = env.step(env.action_space.sample())
        seen.append(result)
        if result[2] or result[3]:
            break
    return seen


def _flat(value: Any) -> bytes:
    if isinstance(value, dict):
        return b"".join(_flat(value[key]) for key in sorted(value))
    if isinstance(value, list | tuple):
        return b"".join(map(_flat, value))
    return np.asarray(value).tobytes()


ADVICE = ("symmetric and normalized space", "minimum value is -infinity", "maximum value is infinity")
"""What the checker says of the torque of a pendulum and of velocities, which have no bounds."""


@pytest.mark.parametrize("name", IDS_FLAT)
def test_gymnasiums_checker_finds_nothing(name: str) -> None:
    env = gym.make(base_task(name).gym_id, render_mode="rgb_array")
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    said = [str(one.message) for one in found]
    assert [text for text in said if not any(advice in text for advice in ADVICE)] == []
    env.close()


@pytest.mark.parametrize("name", IDS_FLAT)
def test_an_episode_is_a_function_of_its_seed_and_its_actions(name: str) -> None:
    one, other = (gym.make(base_task(name).gym_id) for _ in range(2))
    _random_episode(other, seed=5)
    random.seed(1)  # noqa: TID251
    np.random.seed(1)  # noqa: TID251
    first = _flat(_random_episode(one, seed=7))
    random.seed(2)  # noqa: TID251
    np.random.seed(2)  # noqa: TID251
    assert _flat(_random_episode(other, seed=7)) == first
    assert any(_flat(_random_episode(one, seed=seed)) != first for seed in range(8, 16))


@pytest.mark.parametrize("name", IDS)
def test_no_global_generator_is_touched(name: str) -> None:
    env = gym.make(base_task(name).gym_id)
    before = random.getstate(), np.random.get_state()[1].tobytes()  # type: ignore[index, union-attr]
    _random_episode(env, seed=3)
    after = random.getstate(), np.random.get_state()[1].tobytes()  # type: ignore[index, union-attr]
    assert before == after


@pytest.mark.parametrize("name", IDS)
def test_an_episode_ends_once_within_its_horizon_inside_the_declared_spaces_and_gives_no_answer_away(
    name: str,
) -> None:
    row = base_task(name)
    env = make_base_task(name)
    env.spec = gym.spec(row.gym_id)
    assert env.spec.max_episode_steps == row.horizon_steps
    assert not isinstance(env.observation_space, gym.spaces.Tuple | gym.spaces.Text)
    if isinstance(env.observation_space, gym.spaces.Dict):
        assert not any(
            isinstance(s, gym.spaces.Tuple | gym.spaces.Text) for s in env.observation_space.values()
        )
    n_steps = N_MAZE_STEPS if _is_maze(name) else min(row.horizon_steps, 1100)
    steps = _random_episode(env, seed=11, n_steps=n_steps)
    assert steps[1] == {}
    for k, (observation, reward, terminated, truncated, info) in enumerate(steps[2:], 1):
        assert env.observation_space.contains(observation), k
        assert isinstance(reward, float) and isinstance(terminated, bool) and isinstance(truncated, bool)
        assert not (terminated and truncated)
        is_last = terminated or truncated
        assert set(info) == ({"success"} if is_last and row.success else set())
        if k == row.horizon_steps:
            assert is_last
    if terminated or truncated:
        with pytest.raises(gym.error.ResetNeeded):
            env.step(env.action_space.sample())


@pytest.mark.parametrize("name", IDS)
def test_observations_that_were_kept_do_not_change_later(name: str) -> None:
    env = make_base_task(name)
    kept: list[tuple[Any, bytes]] = []
    observation, _ = env.reset(seed=2)
    env.action_space.seed(2)
    for _ in range(12):
        kept.append((observation, _flat(observation)))
        observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            break
    assert all(_flat(one) == digest for one, digest in kept)


@pytest.mark.parametrize("name", IDS)
def test_pictures_show_the_episode_and_have_one_size(name: str) -> None:
    env = make_base_task(name, render_mode="rgb_array")
    env.reset(seed=4)
    env.action_space.seed(4)
    pictures = [env.render()]
    for _ in range(8):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        pictures.append(env.render())
        if terminated or truncated:
            break
    for picture in pictures:
        assert (
            picture is not None and picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
        )
        assert picture.shape == pictures[0].shape  # type: ignore[union-attr]
        assert min(picture.shape[:2]) >= 48 and len(np.unique(picture)) > 1
    assert make_base_task(name).render() is None


@pytest.mark.parametrize("name", IDS)
def test_wrong_actions_and_options_are_refused(name: str) -> None:
    env = make_base_task(name)
    env.reset(seed=0)
    for action in (None, "0", 10**6, -1 - 10**6, [[0] * 7] * 7, float("nan")):
        with pytest.raises(InvalidActionError, match="expected an action"):
            env.step(action)
    with pytest.raises(UnknownNameError, match=r"levle.*Did you mean 'level'"):
        env.reset(seed=0, options={"levle": {}})
    with pytest.raises(TaskArgumentError, match=r"reset\(options\): expected"):
        env.reset(seed=0, options={"level": {"nothing": np.zeros(2)}})


@pytest.mark.parametrize("name", IDS)
def test_the_level_of_an_episode_can_be_given_again(name: str) -> None:
    env = make_base_task(name)
    if not env.level_names:
        pytest.skip("its levels come from seeds alone")
    first, _ = env.reset(seed=6)
    state = env.true_state()
    level = {key: state[key] for key in env.level_names}
    again, _ = env.reset(seed=6, options={"level": level})
    assert _flat(again) == _flat(first)
    assert all(np.array_equal(env.true_state()[key], value) for key, value in level.items())


@pytest.mark.parametrize("name", IDS_FLAT)
def test_the_oracle_is_no_worse_than_random_and_a_memoryless_player_sees_no_state(
    name: str,
) -> None:
    row = base_task(name)
    random_return, best_return = (
        np.mean([player_return(name, kind, seed) for seed in range(3)]) for kind in ("random", "oracle")
    )
    assert best_return >= random_return
    if row.memoryless is not None:
        player_return(name, "memoryless", 0)


def player_return(name: str, kind: Kind, seed: int) -> float:
    shorter = {"horizon_steps": N_MAZE_STEPS} if _is_maze(name) else {}
    env, total, ended = make_base_task(name, **shorter), 0.0, False
    player = player_of(name, kind, env.action_space)
    observation, _ = env.reset(seed=seed)
    player.begin(np.random.default_rng([seed, 7]))  # not the stream of the environment
    while not ended:
        state = env.true_state() if kind == "oracle" else {}
        observation, reward, terminated, truncated, _ = env.step(player.act(observation, state))
        total, ended = total + reward, terminated or truncated
    return total


def test_an_unknown_name_is_answered_with_the_closest() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'MemoryLengthEasy-v0'"):
        base_task("mikasa_base/MemoryLenghtEasy-v0")


def test_the_papers_example_runs_with_our_id() -> None:
    """Listing "Example code for running MemoryLength-v0", with the id that is predefined."""
    env_id = "mikasa_base/MemoryLengthEasy-v0"
    env_kwargs = None
    seed = 123

    env = gym.make(env_id, env_kwargs)

    obs, _ = env.reset(seed=seed)

    for _ in range(11):
        action = env.action_space.sample()
        obs, reward, terminations, truncations, _infos = env.step(action)
    env.close()
    assert obs.shape == (3,) and reward in (-1.0, 1.0) and terminations and not truncations


def test_another_level_says_its_horizon_and_names_arguments_that_exist() -> None:
    env = gym.make("mikasa_base/MemoryLengthEasy-v0", n_delay_steps=20, n_bits=2, horizon_steps=21)
    observation, _ = env.reset(seed=1)
    assert observation.shape == (4,) and env.spec is not None and env.spec.max_episode_steps == 21
    with pytest.raises(TaskArgumentError, match="another level needs its horizon_steps"):
        make_base_task("MemoryLengthEasy-v0", n_delay_steps=20)
    with pytest.raises(UnknownNameError, match="Did you mean 'n_bits'"):
        make_base_task("MemoryLengthEasy-v0", n_bit=2, horizon_steps=5)


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_several_run_side_by_side_as_alone(mode: str) -> None:
    name, n_envs = "mikasa_base/RepeatFirstEasy-v0", 3
    alone = [gym.make(name) for _ in range(n_envs)]
    together = gym.make_vec(name, num_envs=n_envs, vectorization_mode=mode)
    seen, _ = together.reset(seed=5)
    assert seen.tolist() == [env.reset(seed=5 + index)[0] for index, env in enumerate(alone)]
    for action in range(4):
        seen, rewards, *_ = together.step(np.full(n_envs, action))
        results = [env.step(action) for env in alone]
        assert seen.tolist() == [result[0] for result in results]
        assert rewards.tolist() == [result[1] for result in results]
    together.close()


@pytest.mark.parametrize("name", sorted(BASE_TASKS))
def test_every_row_scores_returns_by_its_constants_or_not_at_all(name: str) -> None:
    figures = BASE_TASKS[name].figures
    if figures.memoryless is None or figures.best is None or figures.best <= figures.memoryless:
        assert figures.normalised(0.5) is None
        return
    assert figures.normalised(figures.memoryless) == 0.0
    assert figures.normalised(figures.best) == pytest.approx(1.0)
    middle = (figures.memoryless + figures.best) / 2
    assert figures.normalised(middle) == pytest.approx(0.5)


def test_a_score_is_undefined_where_memory_gains_nothing() -> None:
    for memoryless, best in ((1.0, 1.0), (0.97, 0.96), (None, 1.0), (0.0, None)):
        assert Figures(random=0.0, memoryless=memoryless, best=best, source="").normalised(1.0) is None
