"""Other robots than the Panda: the expert solves a task with each, and what cannot be is refused."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings, RenderSettings
from vla_eval.control_modes import JOINT_DELTA_POS
from vla_eval.core import EpisodeStart
from vla_eval.envs.factory import make_env
from vla_eval.errors import MissingDependencyError, SpecMismatchError, TaskArgumentError, UnknownNameError
from vla_eval.features import proprioception
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_oracle
from vla_eval.robots.arm import Arm
from vla_eval.robots.rows import FETCH as FETCH_ROW
from vla_eval.robots.rows import KOCH, PANDA, ROWS, SO100
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.tasks.catalog import TASKS, family_of, task_spec
from vla_eval.testing.check_env import check_env

TASK = "RememberColor3-v0"
FETCH = {"robot": "fetch"}


def is_installed(arm: Arm) -> bool:
    """Whether a robot's meshes are there: those of some are a download."""
    module, _, name = arm.agent.partition(":")
    try:
        agent = getattr(importlib.import_module(module), name)
        return Path(agent.urdf_path.fget(object.__new__(agent)) if arm.asset else __file__).is_file()
    except MissingDependencyError:
        return False


OTHERS = [
    pytest.param(arm, marks=pytest.mark.skipif(not is_installed(arm), reason=f"no download of {arm.asset}"))
    for arm in ROWS
    if arm is not PANDA
]
every_other = pytest.mark.parametrize("arm", OTHERS, ids=lambda arm: arm.name)


def env_with(**fields: Any) -> Any:
    return make_env(EnvSettings(**{"task": TASK, "kwargs": FETCH, **fields}))


def solve(env: Any, task: str, seed: int, *, n_action_steps: int) -> str:
    """Return the outcome of an episode of the expert."""
    chunking, n_candidates = ChunkingSpec(n_action_steps=n_action_steps), task_spec(task).n_candidates({})
    policy = make_oracle(
        PolicyContext(name="oracle", env=env.spec, chunking=chunking, n_candidates=n_candidates)
    )
    start = EpisodeStart(
        slot=0, task=task, seed=seed, run=0, instruction="do it", horizon_steps=env.spec.horizon_steps
    )
    (record,) = rollout(env, policy, [start], RolloutSettings(chunking=chunking, stop_at_success=True))
    return record.outcome


@every_other
@pytest.mark.parametrize("n_action_steps", [1, 8])
def test_the_expert_touches_the_right_cube_with_every_robot(arm: Arm, n_action_steps: int) -> None:
    env = env_with(kwargs={"robot": arm.name}, privileged=True)
    for seed in (1, 2, 3):
        assert solve(env, TASK, seed, n_action_steps=n_action_steps) == "success", seed


@pytest.mark.parametrize("arm", [SO100, KOCH], ids=lambda arm: arm.name)
def test_the_expert_touches_the_right_cube_by_motions_of_the_joints(arm: Arm) -> None:
    env = env_with(kwargs={"robot": arm.name, "control_mode": JOINT_DELTA_POS}, privileged=True)
    assert solve(env, TASK, 1, n_action_steps=1) == "success"


@pytest.mark.parametrize("task", ["ShellGameTouch-v0", "TakeItBack-v0"])
def test_the_so100_touches_mugs_and_carries_a_cube(task: str) -> None:
    env = env_with(task=task, kwargs={"robot": "so100"}, privileged=True)
    assert [solve(env, task, seed, n_action_steps=1) for seed in (1, 2)] == ["success", "success"]


@pytest.mark.parametrize("arm", [arm for arm in ROWS if arm.asset], ids=lambda arm: arm.name)
def test_an_arm_whose_meshes_are_not_there_says_how_to_get_them_and_asks_nothing(
    arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vla_eval.tasks.arm.robots.ASSET_DIR", "nowhere")
    monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("asked for a download"))
    with pytest.raises(MissingDependencyError, match=rf"mani_skill\.utils\.download_asset {arm.asset}"):
        env_with(kwargs={"robot": arm.name})


@pytest.mark.slow
@every_other
@pytest.mark.parametrize("task", [row.id for row in TASKS.values()])
def test_the_expert_mostly_solves_what_a_robot_is_offered_for(arm: Arm, task: str) -> None:
    if family_of(task_spec(task)) in arm.not_solved:
        pytest.skip("not offered")
    env = env_with(task=task, kwargs={"robot": arm.name}, privileged=True)
    outcomes = [solve(env, task, seed, n_action_steps=1) for seed in range(1, 11)]
    assert outcomes.count("success") >= 7


def test_the_base_of_fetch_stands_still() -> None:
    env = env_with()
    env.reset({0: 1}, render=False)
    for _ in range(30):
        moved = env.step({0: np.array([1, 1, -1, 0, 0, 0, 1], dtype=np.float32)}, render=frozenset())[0]
    joints = dict(zip(env.spec.states[1].dims, moved.observation.state["qpos"], strict=True))
    for name, rest in (("root_x", 0.0), ("root_y", 0.0), ("root_turn", 0.0), ("torso", 0.386)):
        assert abs(joints[name] - rest) < 1e-3, name


@every_other
def test_names_and_bounds_are_those_of_the_simulator_in_every_mode(arm: Arm) -> None:
    for mode in arm.actions:
        env = env_with(kwargs={"robot": arm.name, "control_mode": mode})
        space = env._envs[0].single_action_space
        assert space.low.tolist() == list(env.spec.action.low)
        assert space.high.tolist() == list(env.spec.action.high)
        robot = env._envs[0].agent.robot
        assert [joint.name for joint in robot.active_joints][-1] == arm.joints[-1] or arm is FETCH_ROW
        assert robot.max_dof == len(arm.joints)
        env.close()


@pytest.mark.parametrize("arm", [SO100, KOCH], ids=lambda arm: arm.name)
def test_a_small_arm_keeps_the_contract_of_an_environment(arm: Arm) -> None:
    check_env(lambda: env_with(kwargs={"robot": arm.name}, privileged=True), renders=False, n_steps=4)


@every_other
def test_an_arm_that_is_held_stays_where_it_is(arm: Arm) -> None:
    for mode in arm.actions:
        env = env_with(kwargs={"robot": arm.name, "control_mode": mode})
        before = env.reset({0: 3}, render=False)[0].observation.state["qpos"]
        for _ in range(4):
            held = env.step({0: env.hold_action(0)}, render=frozenset())[0]
        np.testing.assert_allclose(held.observation.state["qpos"], before, atol=2e-3)
        env.close()


@every_other
def test_both_cameras_show_the_cue(arm: Arm) -> None:
    env = env_with(kwargs={"robot": arm.name}, cameras=("base_camera", "hand_camera"))
    shown = env.reset({0: 1}, render=True)[0].observation.images
    held = [env.step({0: env.hold_action(0)}, render=frozenset([0]))[0] for _ in range(7)]
    hidden = held[-1].observation.images  # the delay: the table is empty
    for camera, image in shown.items():
        changed = np.abs(image.astype(int) - hidden[camera]).max(axis=2) > 40
        assert changed.sum() > 10, camera


def test_it_has_the_same_actions_and_cameras_and_says_the_names_of_its_joints() -> None:
    panda, fetch = make_env(EnvSettings(task=TASK)).spec, env_with().spec
    assert (panda.robot, fetch.robot) == ("panda_wristcam", "fetch")
    assert fetch.action == panda.action
    assert fetch.cameras == panda.cameras
    assert [len(state.dims) for state in fetch.states] == [7, 15, 15]
    assert fetch.states[1].dims[-2:] == panda.states[1].dims[-2:] == ("finger1", "finger2")


@pytest.mark.parametrize("kwargs", [FETCH, {"robot_uids": "fetch_at_table"}])
def test_the_old_name_of_a_robot_gives_the_same_episodes(kwargs: dict[str, str]) -> None:
    env, named = env_with(kwargs=kwargs), env_with()
    for one in (env, named):
        one.reset({0: 5}, render=False)
    action = np.full(7, 0.3, dtype=np.float32)
    states = [one.step({0: action}, render=frozenset())[0].observation.state for one in (env, named)]
    np.testing.assert_equal(states[0], states[1])


def test_a_task_that_it_does_not_solve_or_a_mistyped_name_is_refused() -> None:
    with pytest.raises(TaskArgumentError, match=r"robot='fetch': this robot does not solve TakeItBack-v0: "):
        env_with(task="TakeItBack-v0")
    with pytest.raises(UnknownNameError, match="Did you mean 'fetch_at_table'"):
        env_with(kwargs={"robot_uids": "fetch_at_tabel"})


def test_the_pandas_mesh_on_another_arm_is_refused() -> None:
    with pytest.raises(TaskArgumentError, match=r"render\.wrist_mesh='simplified'"):
        env_with(render=RenderSettings(wrist_mesh="simplified"))


def test_datasets_and_learned_policies_do_not_take_its_joints_for_the_pandas() -> None:
    state = {"tcp_pose": np.zeros(7), "qpos": np.zeros(15), "qvel": np.zeros(15)}
    with pytest.raises(
        SpecMismatchError,
        match=r"expected the 9 joints of the robot panda_wristcam, found 15\. .*env\.robot=panda_wristcam",
    ):
        proprioception(state)
