"""Episodes of the original code, repeated: same seed, same actions, same observations, rewards and end."""

import json
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import vla_eval.base_tasks.register  # noqa: F401
from tests.base_tasks.golden_episodes import GoldenEpisode, golden_episodes, golden_ids, short_digest
from vla_eval.base_tasks.catalog import BASE_TASKS

pytestmark = pytest.mark.skipif(find_spec("popgym") is None, reason="needs `make base`")


def _visual_match_level(one: GoldenEpisode) -> dict[str, Any]:
    colors = json.loads(str(one.level["colours"]))
    return {
        "maps": [[list(row) for row in rows] for rows in json.loads(str(one.level["arts"]))],
        "target": one.level["target_char"],
        "colors": [[255 * number // 1000 for number in colors[pad]] for pad in "bce"],
    }


LEVELS: dict[str, Callable[[GoldenEpisode], dict[str, Any]]] = {
    "VisualMatch": _visual_match_level,
    "Numpad": lambda one: {"sequence": one.level["seq"], "ball": one.level["ball"]},
}
"""Family -> the level to give, for environments whose original ignores the seed."""

SHORTER_HERE = ("MineSweeper", "MemoryCards")
"""popgym 1.0.7 ends MineSweeper a step earlier than the official copy; that of Memory Cards has no limit."""

IN_3D = ("ViZDoom", "MemoryMaze")
COMPARED = [
    name for name in golden_ids() if name in BASE_TASKS and not name.startswith(("ViZDoom", "MemoryMaze"))
]


def _begin(env: Any, episode: GoldenEpisode, family: str) -> Any:
    level = LEVELS.get(family)
    options = None if level is None else {"level": level(episode)}
    return env.reset(seed=episode.seed, options=options)[0]


def test_every_id_of_the_golden_values_is_in_the_catalogue_under_its_name() -> None:
    assert set(golden_ids()) == set(BASE_TASKS)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", COMPARED)
def test_episodes_of_the_original_repeat_bit_for_bit(name: str) -> None:
    row = BASE_TASKS[name]
    env = gym.make(row.gym_id)
    n_episodes = 0
    for episode in golden_episodes(name):
        observation = _begin(env, episode, row.family)
        for step, action in enumerate(episode.actions):
            where = f"{name} seed {episode.seed} {episode.policy} step {step}"
            _assert_same(observation, episode, step, where)
            observation, reward, terminated, truncated, _ = env.step(action)
            assert reward == pytest.approx(episode.rewards[step], abs=1e-12), where
            if truncated and step + 1 == row.horizon_steps and row.family in SHORTER_HERE:
                break
            last = step == len(episode.actions) - 1 and not episode.meta.get("capped", False)
            assert (terminated or truncated) == last, where
        else:
            _assert_same(observation, episode, step + 1, f"{name} seed {episode.seed}: the last one")
        n_episodes += 1
    assert n_episodes >= 3
    env.close()


def _assert_same(observation: Any, episode: GoldenEpisode, step: int, where: str) -> None:
    if "obs" in episode.fields:
        np.testing.assert_allclose(observation, episode.fields["obs"][step], atol=1e-5, err_msg=where)
    else:
        assert short_digest(observation, episode.meta) == bytes(episode.fields["sha256"][step]), where
