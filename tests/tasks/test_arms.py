"""Another arm than the Panda: the expert solves a task with it, and what cannot be is refused."""

from typing import Any

import numpy as np
import pytest

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings, RenderSettings
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.errors import SpecMismatchError, TaskArgumentError, UnknownNameError
from vla_eval.features import proprioception
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_oracle
from vla_eval.rollout import RolloutSettings, rollout

TASK = "RememberColor3-v0"
FETCH = {"robot_uids": "fetch_at_table"}


def env_with(**fields: Any) -> Any:
    return make_env(EnvSettings(**{"task": TASK, "kwargs": FETCH, **fields}))


@pytest.mark.parametrize("n_action_steps", [1, 8])
def test_the_expert_touches_the_right_cube_with_another_arm_whose_base_stands_still(
    n_action_steps: int,
) -> None:
    env, chunking = env_with(privileged=True), ChunkingSpec(n_action_steps=n_action_steps)
    policy = make_oracle(PolicyContext(name="oracle", env=env.spec, chunking=chunking, n_candidates=3))
    for seed in (1, 2, 3):
        start = EpisodeStart(slot=0, task=TASK, seed=seed, run=0, instruction="touch it", horizon_steps=60)
        (record,) = rollout(env, policy, [start], RolloutSettings(chunking=chunking))
        assert record.outcome == "success", seed
        held = env.step({0: env.hold_action(0)}, render=frozenset())[0]
        joints = dict(zip(env.spec.states[1].dims, held.observation.state["qpos"], strict=True))
        for name, rest in (("root_x", 0.0), ("root_y", 0.0), ("root_turn", 0.0), ("torso", 0.386)):
            assert abs(joints[name] - rest) < 1e-3, (seed, name)


def test_it_has_the_same_actions_and_cameras_and_says_the_names_of_its_joints() -> None:
    panda, fetch = make_env(EnvSettings(task=TASK)).spec, env_with().spec
    assert fetch.action == panda.action
    assert fetch.cameras == panda.cameras
    assert [len(state.dims) for state in fetch.states] == [7, 15, 15]
    assert fetch.states[1].dims[-2:] == panda.states[1].dims[-2:] == ("finger1", "finger2")


def test_a_task_beyond_its_reach_or_a_mistyped_name_is_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"fetch_at_table.*panda_wristcam"):
        env_with(task="InterceptMedium-v0")
    with pytest.raises(UnknownNameError, match="Did you mean 'fetch_at_table'"):
        env_with(kwargs={"robot_uids": "fetch_at_tabel"})


def test_the_pandas_mesh_on_another_arm_is_refused() -> None:
    with pytest.raises(TaskArgumentError, match=r"render\.wrist_mesh='simplified'"):
        env_with(render=RenderSettings(wrist_mesh="simplified"))


def test_datasets_and_learned_policies_do_not_take_its_joints_for_the_pandas() -> None:
    state = {"tcp_pose": np.zeros(7), "qpos": np.zeros(15), "qvel": np.zeros(15)}
    with pytest.raises(SpecMismatchError, match="expected the 9 joints of the Panda, found 15"):
        proprioception(state)
