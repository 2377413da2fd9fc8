"""The GPU simulator, where SAPIEN has its PhysX library for it. Not run on machines without a GPU."""

from typing import Any

import numpy as np
import pytest

from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import make_env
from vla_eval.tasks.objects.bodies import pose_of
from vla_eval.testing import check_env

pytestmark = pytest.mark.gpu
N_SLOTS = 4


@pytest.mark.parametrize("task", ["RememberColor3-v0", "ShellGameTouch-v0"])
def test_candidates_lie_at_their_places_at_the_reveal_in_every_slot(task: str) -> None:
    env: Any = make_env(EnvSettings(task=task, sim_backend="gpu", n_slots=N_SLOTS, privileged=True))
    env.reset({slot: slot + 1 for slot in range(N_SLOTS)}, render=False)
    for _ in range(15):
        env.step({slot: env.hold_action(slot) for slot in range(N_SLOTS)}, render=frozenset())
    inner = env._envs[0]
    assert np.allclose(inner.candidate_positions_m(), inner._slots, atol=2e-3)


def test_an_episode_does_not_depend_on_the_slots_beside_it() -> None:
    def final_state(seeds: list[int]) -> np.ndarray:
        settings = EnvSettings(task="RememberColor3-v0", sim_backend="gpu", n_slots=len(seeds))
        env: Any = make_env(settings)
        env.reset(dict(enumerate(seeds)), render=False)
        result = None
        for _ in range(20):
            actions = {slot: np.full(7, 0.1, dtype=np.float32) for slot in range(len(seeds))}
            result = env.step(actions, render=frozenset())
        assert result is not None
        state: np.ndarray = result[0].observation.state["qpos"]
        return state

    assert np.allclose(final_state([1]), final_state([1, 2, 3, 4]), atol=1e-5)


def test_the_environment_keeps_its_contract() -> None:
    check_env(lambda: make_env(EnvSettings(task="RememberColor3-v0", sim_backend="gpu")), renders=False)


def test_things_beside_a_task_stand_where_they_stand_on_the_cpu() -> None:
    def places(seeds: list[int], **backend: Any) -> np.ndarray:
        settings = EnvSettings(task="RememberColor3-v0", kwargs={"clutter": 4}, n_slots=len(seeds), **backend)
        env: Any = make_env(settings)
        env.reset(dict(enumerate(seeds)), render=False)
        return np.stack([pose_of(actor)[-1] for actor in env._envs[0]._clutter._actors])

    assert np.allclose(places([1, 2], sim_backend="gpu"), places([2]), atol=1e-5)
