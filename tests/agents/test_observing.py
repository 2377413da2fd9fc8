"""What agents are given: `vector` has nothing that has to be remembered, `state` all; episodes, rewards."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="needs `make rl`")

from tests.agents.tiny_agents import BIT, ROBOT
from vla_eval.agents.vector_env import SlotsEnv, reward_of
from vla_eval.base_tasks.named import as_named, leaves_of, spaces_of
from vla_eval.config.agents import TRAINING_SEEDS
from vla_eval.config.environment import EnvSettings
from vla_eval.core import Observation, StepResult
from vla_eval.envs.factory import describe_env, make_env
from vla_eval.errors import RecipeError, UnknownNameError
from vla_eval.policies.agents.imitator import as_inputs
from vla_eval.policies.agents.observing import PLACES, VECTOR, Reader, action_space, as_action, reader_of
from vla_eval.task_state import PrivilegedState, TaskStatus
from vla_eval.tasks.catalog import TASKS, task_spec

N = 3


def robot_reader(mode: str, task: str = ROBOT) -> Reader:
    env = describe_env(EnvSettings(task=task, simulator="fake"))
    return reader_of(env, mode, n_candidates=task_spec(task).n_candidates({}))  # type: ignore[arg-type]


def seen(
    rng: np.random.Generator, *, phase: str, right: tuple[int, ...], shown: tuple[int, ...]
) -> Observation:
    """Return an observation of an arm that is where `rng` puts it."""
    world = PrivilegedState(
        phase=phase,  # type: ignore[arg-type]
        response_step=10,
        tcp_position_m=rng.normal(size=3),
        tcp_velocity_m_s=rng.normal(size=3),
        gripper_width_m=0.04,
        candidate_positions_m=rng.normal(size=(N, 3)),
        right_candidates=right,
        shown_candidates=shown,
    )
    state = {"qpos": rng.normal(size=9).astype(np.float32), "tcp_pose": rng.normal(size=7).astype(np.float32)}
    return Observation(step=3, images={}, state=state, privileged=world)


@pytest.mark.parametrize("phase", ["delay", "response"])
@pytest.mark.parametrize("other", [(0,), (2,), (1, 0)])
def test_after_the_cue_a_vector_does_not_depend_on_which_candidate_is_right(
    phase: str, other: tuple[int, ...]
) -> None:
    one, changed = (
        seen(np.random.default_rng(4), phase=phase, right=right, shown=()) for right in ((1,), other)
    )
    vector, state = robot_reader("vector").read, robot_reader("state").read
    np.testing.assert_array_equal(as_inputs(vector(one)), as_inputs(vector(changed)))
    assert not np.array_equal(state(one)[VECTOR], state(changed)[VECTOR])


def test_before_the_response_a_vector_does_not_depend_on_where_candidates_will_be() -> None:
    first = seen(np.random.default_rng(4), phase="delay", right=(1,), shown=())
    assert isinstance(first.privileged, PrivilegedState)
    moved = replace(first, privileged=replace(first.privileged, candidate_positions_m=np.ones((N, 3))))
    read = robot_reader("vector").read
    np.testing.assert_array_equal(as_inputs(read(first)), as_inputs(read(moved)))
    due = [replace(one, privileged=replace(one.privileged, phase="response")) for one in (first, moved)]
    assert not np.array_equal(read(due[0])[PLACES], read(due[1])[PLACES])
    assert read(due[0])[PLACES].shape == (N, 3)


def test_a_vector_shows_the_cue_while_it_is_shown() -> None:
    read = robot_reader("vector").read
    cues = [
        read(seen(np.random.default_rng(4), phase="cue", right=(k,), shown=(k,)))[VECTOR] for k in range(N)
    ]
    assert len({cue.tobytes() for cue in cues}) == N


def test_each_task_with_candidates_has_a_vector_and_each_task_a_state_of_one_length() -> None:
    for task in TASKS.values():
        if task.suite != "paper":
            continue
        env = make_env(EnvSettings(task=task.id, simulator="fake", privileged=True, n_slots=2))
        results = [env.reset({0: 1, 1: 2}, render=False)]
        results += [env.step({k: env.hold_action(k) for k in (0, 1)}, render=frozenset()) for _ in range(60)]
        n_candidates = task.n_candidates({})
        for mode in ("state", *(["vector"] if n_candidates else [])):
            reader = reader_of(env.spec, mode, n_candidates=n_candidates)  # type: ignore[arg-type]
            shapes = {reader.read(result[k].observation)[VECTOR].shape for result in results for k in (0, 1)}
            assert len(shapes) == 1, (task.id, mode)


@pytest.mark.parametrize("task", ["mikasa_base/RepeatFirstEasy-v0", "mikasa_base/ConcentrationEasy-v0", BIT])
def test_a_choice_of_several_is_a_number_per_choice(task: str) -> None:
    pytest.importorskip("popgym", reason="needs `make base`")
    space, _ = spaces_of(task)
    env = describe_env(EnvSettings(task=task))
    read = reader_of(env, None, n_candidates=0).read
    space.seed(3)
    for _ in range(5):
        images, state = as_named(space.sample())
        vector = read(Observation(step=0, images=images, state=state))[VECTOR]
        hot = [leaf for _, leaf in leaves_of(space) if isinstance(leaf, gym.spaces.Discrete)]
        several = [leaf for _, leaf in leaves_of(space) if isinstance(leaf, gym.spaces.MultiDiscrete)]
        n_ones = len(hot) + sum(leaf.nvec.size for leaf in several)
        length = sum(int(leaf.n) for leaf in hot) + sum(int(leaf.nvec.sum()) for leaf in several)
        if len(hot) + len(several) == len(leaves_of(space)):
            assert vector.sum() == n_ones and vector.shape == (length,) and set(vector) <= {0, 1}


@pytest.mark.parametrize(
    ("task", "mode", "message"),
    [
        ("InterceptMedium-v0", "vector", "has no candidates"),
        (ROBOT, "image", "observation"),
        (ROBOT, "vectr", "Did you mean 'vector'"),
    ],
)
def test_what_a_task_does_not_have_is_refused(task: str, mode: str, message: str) -> None:
    with pytest.raises((RecipeError, UnknownNameError), match=message):
        robot_reader(mode, task)


def test_actions_of_all_spaces_come_back_as_numbers_within_their_bounds() -> None:
    pytest.importorskip("popgym", reason="needs `make base`")
    for task in (
        BIT,
        "mikasa_base/RepeatFirstEasy-v0",
        "mikasa_base/BattleshipEasy-v0",
        "mikasa_base/PositionOnlyPendulumEasy-v0",
    ):
        env = describe_env(EnvSettings(task=task))
        space = action_space(env.action)
        space.seed(0)
        for _ in range(10):
            action = as_action(env.action, space.sample())
            assert action.shape == (len(env.action.dims),)
            assert np.all(action >= env.action.low) and np.all(action <= env.action.high)


def envs_of(task: str, n_slots: int, *, reward: str = "dense", run_seed: int = 0) -> SlotsEnv:
    is_base = task_spec(task).is_base
    settings = EnvSettings(
        task=task, simulator="maniskill" if is_base else "fake", privileged=not is_base, n_slots=n_slots
    )
    env = make_env(settings)
    reader = reader_of(env.spec, None, n_candidates=task_spec(task).n_candidates({}))
    return SlotsEnv(env, reader, n_slots=n_slots, reward=reward, run_seed=run_seed)  # type: ignore[arg-type]


def test_an_episode_that_its_rules_end_is_not_cut_off_and_one_at_the_horizon_is() -> None:
    robot, bit = envs_of(ROBOT, 2), envs_of(BIT, 2)
    for envs, cut in ((robot, True), (bit, False)):
        envs.reset()
        horizon = envs._env.spec.horizon_steps
        for step in range(1, horizon + 1):
            actions = np.stack([envs.action_space.sample() for _ in range(2)])
            _, _, dones, infos = envs.step(actions)
            assert dones.all() == (step == horizon)
        assert [info["TimeLimit.truncated"] for info in infos] == [cut, cut]
        assert all("terminal_observation" in info for info in infos)


def test_episodes_are_a_function_of_run_seed_checkpoint_slot_and_count() -> None:
    def first_seeds(run_seed: int, segment: int, n_slots: int) -> list[int]:
        envs = envs_of(ROBOT, n_slots, run_seed=run_seed)
        envs.begin_segment(segment)
        return [envs._next_seed(slot) for slot in range(n_slots) for _ in range(3)]

    wide, narrow = first_seeds(0, 0, 4), first_seeds(0, 0, 2)
    assert wide[:6] == narrow and len(set(wide)) == 12 and all(seed in TRAINING_SEEDS for seed in wide)
    assert not set(wide) & set(first_seeds(1, 0, 4)) and not set(wide) & set(first_seeds(0, 16, 4))


def test_a_sparse_reward_is_one_while_the_success_rule_holds_and_the_dense_one_the_task_s() -> None:
    observation = Observation(step=1, images={}, state={})
    results = [
        StepResult(observation=observation, status=TaskStatus(phase=None, success=success), reward=0.25)
        for success in (False, True)
    ]
    assert [reward_of(result, "sparse") for result in results] == [0.0, 1.0]
    assert [reward_of(result, "dense") for result in results] == [0.25, 0.25]
