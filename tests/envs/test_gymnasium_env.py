"""The tasks as Gymnasium environments: Gymnasium's own checks, an evaluation's episodes, what is refused."""

import inspect
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from mani_skill.envs.sapien_env import BaseEnv

import vla_eval
import vla_eval.tasks.register
from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.config.prompts import instruction_for
from vla_eval.core import ActionChunk, EpisodeStart, Observation, ObservationWindow
from vla_eval.envs.factory import make_env
from vla_eval.envs.gymnasium_env import ONLY_MANISKILL
from vla_eval.errors import InvalidActionError, MissingDependencyError, TaskArgumentError, UnknownNameError
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.specs import PolicySpec
from vla_eval.tasks.catalog import TASKS, task_spec

TASK = "RememberColor3-v0"
ID = f"vla_eval/{TASK}"
SEED, N_STEPS = 7, 4
SHORT: dict[str, Any] = {"cue_steps": 1, "delay_steps": 1, "horizon_steps": N_STEPS}
FAKE: dict[str, Any] = {**SHORT, "simulator": "fake"}
CAMERAS = ("base_camera", "hand_camera")
PAGE = Path(__file__).parents[2] / "docs" / "gymnasium.md"


class Shaking:
    """Moves at random, also beyond the bounds, and keeps what it was given."""

    def __init__(self) -> None:
        self.spec = PolicySpec(
            name="shaking",
            reads="every",
            cameras=CAMERAS,
            states=("tcp_pose", "qpos", "qvel"),
            chunk_size=1,
        )
        self.actions = np.random.default_rng(3).uniform(-1.5, 1.5, (N_STEPS, 7)).astype(np.float32)
        self.given: list[Observation] = []

    def reset(self, episodes: Any) -> None:
        pass

    def act(self, window: ObservationWindow) -> ActionChunk:
        self.given.append(window.last)
        return ActionChunk(actions=self.actions[window.last.step][None])


def test_an_episode_is_that_of_an_evaluation() -> None:
    policy = Shaking()
    harness = make_env(EnvSettings(task=TASK, kwargs=SHORT, cameras=CAMERAS))
    start = EpisodeStart(slot=0, task=TASK, seed=SEED, run=0, instruction="x", horizon_steps=N_STEPS)
    settings = RolloutSettings(chunking=ChunkingSpec(n_action_steps=1))
    (record,) = rollout(harness, policy, [start], settings)
    harness.close()

    env = gymnasium.make(ID, **SHORT)
    observation, info = env.reset(seed=SEED)
    seen, phases = [observation], [info["phase"]]
    rewards: list[float] = []
    for action in policy.actions:
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append(observation)
        rewards.append(float(reward))
        phases.append(info["phase"])
    env.close()
    assert (terminated, truncated, info["success"], info["seed"]) == (False, True, False, SEED)
    assert phases == ["cue", "delay", "response", "response", "response"]
    assert sum(rewards) == pytest.approx(record.episode_return)
    for given, got in zip(policy.given, seen, strict=False):
        assert {**got["images"], **got["state"]}.keys() == {**given.images, **given.state}.keys()
        for name, expected in {**given.images, **given.state}.items():
            np.testing.assert_array_equal({**got["images"], **got["state"]}[name], expected, err_msg=name)
    assert info["instruction"] == instruction_for(task_spec(TASK))
    assert observation["images"]["hand_camera"].shape == (128, 128, 3)


def test_gymnasiums_checker_finds_nothing() -> None:
    env = gymnasium.make(ID, **SHORT)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    # Joints and poses have no bounds; ManiSkill compares torch tensors by numpy.
    known = ("infinity", "__array_wrap__")
    assert [text for one in said if not any(part in (text := str(one.message)) for part in known)] == []
    assert env.render_mode == "rgb_array"
    env.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_a_vector_has_the_episodes_of_its_seeds(mode: str) -> None:
    context: dict[str, Any] = {"vector_kwargs": {"context": "spawn"}} if mode == "async" else {}
    vector: Any = gymnasium.make_vec(ID, num_envs=2, vectorization_mode=mode, **context, **FAKE)
    observations, infos = vector.reset(seed=[4, 9])
    single = vla_eval.make_env(TASK, **FAKE)
    for row, seed in enumerate((4, 9)):
        expected, _ = single.reset(seed=seed)
        for camera in CAMERAS:
            np.testing.assert_array_equal(observations["images"][camera][row], expected["images"][camera])
    assert infos["seed"].tolist() == [4, 9]
    assert infos["instruction"].tolist() == [instruction_for(task_spec(TASK))] * 2
    vector.step(np.zeros((2, 7), dtype=np.float32))
    vector.close()


@pytest.mark.parametrize("name", [*ONLY_MANISKILL, "render_backend"])
def test_a_script_for_the_environment_that_had_this_id_is_told_the_new_id(name: str) -> None:
    value: Any = {"num_envs": 2, "render_backend": "none"}.get(name, "state")
    with pytest.raises(TaskArgumentError, match=re.escape(f'"vla_eval_maniskill/{TASK}"')) as told:
        gymnasium.make(ID, **dict[str, Any]({name: value}))
    assert name in str(told.value) and "make_vec" in str(told.value)


def test_every_argument_of_maniskill_that_is_not_ours_is_known() -> None:
    taken = {
        *("self", "render_mode", "robot_uids", "control_mode", "render_backend", "robot_init_qpos_noise"),
        *inspect.signature(vla_eval.make_env).parameters,
    }
    assert set(inspect.signature(BaseEnv.__init__).parameters) - taken <= set(ONLY_MANISKILL)


@pytest.mark.skipif(torch.cuda.is_available(), reason="for machines without a GPU")
def test_several_episodes_in_maniskill_without_a_gpu_say_what_to_do() -> None:
    with pytest.raises(MissingDependencyError, match=r"make_vec\(.*spawn"):
        gymnasium.make(TASKS[TASK].maniskill_id, num_envs=2, obs_mode="state")


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"delay_step": 20}, UnknownNameError, "delay_steps"),
        ({"control_mode": "pd_ee_delta"}, UnknownNameError, "pd_ee_delta_pose"),
        ({"cameras": ["hand"]}, UnknownNameError, "hand_camera"),
        ({"horizon_steps": 8}, TaskArgumentError, "horizon_steps=8"),
        ({"wrist_mesh": "simple"}, UnknownNameError, "simplified"),
    ],
)
def test_a_mistake_is_told_before_a_simulator_starts(
    arguments: dict[str, Any], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        vla_eval.make_env(TASK, **arguments)


def test_misuse_is_told() -> None:
    env = vla_eval.make_env(TASK, **FAKE)
    for call in (lambda: env.step(np.zeros(7)), env.render, env.hold_action):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    env.reset(seed=1)
    for action in (np.zeros(6), np.full(7, np.nan), np.zeros((1, 7))):
        with pytest.raises(InvalidActionError, match="7 finite numbers"):
            env.step(action)


def test_arguments_change_what_they_say() -> None:
    env = vla_eval.make_env(TASK, image_size=32, cameras=["hand_camera"], **FAKE)
    observation, _ = env.reset(seed=1)
    assert [image.shape for image in observation["images"].values()] == [(32, 32, 3)]
    assert vla_eval.make_env(TASK, control_mode="pd_joint_pos").action_space.shape == (8,)
    assert env.render().shape == (32, 32, 3)
    blind = vla_eval.make_env(TASK, cameras=(), **FAKE)
    assert blind.reset(seed=1)[0]["images"] == {}
    assert blind.render_mode is None


def test_a_reset_without_a_seed_says_which_episode_it_is() -> None:
    env = vla_eval.make_env(TASK, **FAKE)
    first, info = env.reset()
    again, _ = env.reset(seed=info["seed"])
    np.testing.assert_array_equal(first["images"]["base_camera"], again["images"]["base_camera"])


@pytest.mark.parametrize("as_script", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_page_on_gymnasium_works(
    as_script: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a script, processes that it spawns import the whole simulator again, each in seconds."""
    monkeypatch.chdir(tmp_path)
    blocks = [
        block.partition("```")[0] for block in PAGE.read_text(encoding="utf-8").split("```python\n")[1:]
    ]
    assert len(blocks) == 4
    for block in blocks:
        small = block.replace("delay_steps=20", "delay_steps=2")
        if "spawn" in block and not as_script:
            exec(small.replace("num_envs=2", 'num_envs=2, simulator="fake"'), {"__name__": "__main__"})
        elif "spawn" in block:  # its processes import the script
            (tmp_path / "script.py").write_text(small, "utf-8")
            subprocess.run([sys.executable, "script.py"], timeout=300, check=True)
        elif "num_envs=64" in block and not torch.cuda.is_available():
            with pytest.raises(MissingDependencyError, match="make_vec"):
                exec(small, {"__name__": "__main__"})
        else:
            exec(small, {"__name__": "__main__"})
