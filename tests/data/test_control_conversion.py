"""Converting a recording to another control mode: the same motion, success checked, what is lost is named."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.data.recorded_episodes import entry_of
from vla_eval.cli.main import main
from vla_eval.config.dataset import DatasetRecipe
from vla_eval.config.environment import EnvSettings
from vla_eval.control_modes import CONTROL_MODES, EE_DELTA_POSE, JOINT_DELTA_POS, JOINT_POS
from vla_eval.core import Observation, ObservationWindow
from vla_eval.data.derived.changed_actions import copy_with_actions
from vla_eval.data.derived.control_conversion import AimFollower, convert_episode
from vla_eval.data.facts import read_facts
from vla_eval.data.manifest import RecordedEpisode, decode_actions, encode_actions, read_manifest
from vla_eval.data.opening import open_dataset
from vla_eval.data.recording.demonstrations import NoisyEnv, attempt
from vla_eval.data.recording.plan import plan_recording
from vla_eval.data.tables import read_columns
from vla_eval.envs.factory import make_env
from vla_eval.errors import DatasetError
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_oracle
from vla_eval.strict.decoding import decode
from vla_eval.training.dataset import training_dataset

TASK = "RememberColor3-v0"
COLUMNS = {"episode_index": np.array([0])}  # the table is read only where states differ


def recipe(mode: str) -> DatasetRecipe:
    fields = {"name": "test", "tasks": [TASK], "env": {"control_mode": mode}, "steps_after_success": 3}
    return decode(DatasetRecipe, fields, where="test")


def plan(mode: str) -> Any:
    return plan_recording(recipe(mode)).tasks[0]


def quiet(_stage: object) -> None:
    pass


def env_in(mode: str, **kwargs: Any) -> Any:
    return make_env(EnvSettings(task=TASK, kwargs={"control_mode": mode, **kwargs}, privileged=True))


def recorded_episode(env: Any, *, noise: float) -> RecordedEpisode:
    """Return what a recording with noise would say of one episode."""
    how = plan(EE_DELTA_POSE)
    context = PolicyContext(name="oracle", env=env.spec, chunking=how.group.rollout.chunking, n_candidates=3)
    start = how.start(1000, horizon_steps=env.spec.horizon_steps)
    one = attempt(NoisyEnv(env, noise), make_oracle(context), start, how.group.rollout, heartbeat=quiet)
    return entry_of(one)


def test_targets_of_the_joints_lead_to_the_same_states_and_deltas_of_them_to_success() -> None:
    old = env_in(EE_DELTA_POSE)
    episode = recorded_episode(old, noise=0.05)
    found = {}
    for mode in (JOINT_POS, JOINT_DELTA_POS):
        found[mode], why = convert_episode(old, env_in(mode), episode, COLUMNS, plan(mode))
        assert why == ""

    same = found[JOINT_POS]
    assert same.states_sha256 == episode.states_sha256  # bit for bit
    assert (same.success_step, same.n_steps) == (episode.success_step, episode.n_steps)
    executed = decode_actions(same.actions, n_dims=8)
    assert same.intended_actions is not None
    intended = decode_actions(same.intended_actions, n_dims=8)
    # The noise of 0.05 units of 0.1 m is some mm, at most some hundredths of a radian.
    assert 0 < np.abs(executed - intended).max() < 0.1
    np.testing.assert_array_equal(executed[:, -1], episode.action_rows()[:, -1])
    bounded = found[JOINT_DELTA_POS]
    assert np.abs(decode_actions(bounded.actions, n_dims=8)).max() <= 1
    assert bounded.success_step is not None and episode.success_step is not None
    assert bounded.success_step >= episode.success_step  # 0.1 rad per step is slower than 0.1 m


def test_an_episode_that_does_not_succeed_in_the_other_mode_is_named() -> None:
    old, new = env_in(EE_DELTA_POSE), env_in(JOINT_DELTA_POS, horizon_steps=21)
    _, why = convert_episode(old, new, recorded_episode(old, noise=0.0), COLUMNS, plan(JOINT_DELTA_POS))
    assert why == "no success in pd_joint_delta_pos within 21 steps"


def test_a_simulator_without_joints_cannot_tell_where_they_aim() -> None:
    fake = make_env(EnvSettings(task=TASK, simulator="fake"))
    episode = recorded_episode(env_in(EE_DELTA_POSE), noise=0.0)
    with pytest.raises(DatasetError, match="recorded with a simulator without joints"):
        convert_episode(fake, fake, episode, COLUMNS, plan(JOINT_POS))


def test_the_copy_has_the_new_actions_with_their_statistics_and_everything_else_as_it_was(
    recorded: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    rows = [rng.uniform(-1, 1, (one.n_steps, 8)).astype(np.float32) for one in read_manifest(recorded)]
    episodes = [
        replace(one, env_kwargs={"control_mode": JOINT_POS}, actions=encode_actions(new))
        for one, new in zip(read_manifest(recorded), rows, strict=True)
    ]
    path = tmp_path / "joints" / TASK
    before = read_columns(recorded)

    copy_with_actions(recorded, path, episodes, recipe(JOINT_POS))

    after = read_columns(path)
    everything = np.concatenate(rows)
    np.testing.assert_array_equal(after.pop("action").astype(np.float32), everything)
    del before["action"]
    assert after.keys() == before.keys()
    assert all(np.array_equal(after[name], before[name]) for name in before)
    dataset = open_dataset(path).lerobot()  # checks every file's digest
    assert dataset.meta.features["action"]["names"] == list(CONTROL_MODES[JOINT_POS].dims)
    assert dataset[3]["action"].shape == (8,)
    stats = json.loads((path / "meta/stats.json").read_text())
    np.testing.assert_allclose(stats["action"]["mean"], everything.astype(float).mean(axis=0))
    table = pq.read_table(next(path.glob("meta/episodes/*/*.parquet")))
    own = table["stats/action/max"][1].as_py()
    np.testing.assert_allclose(own, rows[1].max(axis=0))
    assert read_facts(path).control_mode == JOINT_POS
    assert read_facts(recorded).control_mode == EE_DELTA_POSE
    assert training_dataset(path, allow_unreplayed=True).facts.control_mode == JOINT_POS
    with pytest.raises(DatasetError, match="is there already"):
        copy_with_actions(recorded, path, episodes, recipe(JOINT_POS))


def test_beyond_the_recorded_steps_the_last_place_is_aimed_at() -> None:
    actions = np.zeros((2, 7), dtype=np.float32)
    actions[:, -1] = (0.5, -0.5)
    aims = np.arange(14.0).reshape(2, 7) / 10
    follower = AimFollower(aims, recorded_like(actions), old_mode=EE_DELTA_POSE, mode=JOINT_POS)
    seen = Observation(step=9, images={}, state={"qpos": np.zeros(9, dtype=np.float32)})
    chunk = follower.act(ObservationWindow(slot=0, frames=(seen,)))
    np.testing.assert_allclose(chunk.actions, [[0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, -0.5]], rtol=1e-6)


def recorded_like(actions: Any) -> RecordedEpisode:
    return RecordedEpisode(
        episode_index=0,
        task=TASK,
        task_version=1,
        env_kwargs={},
        seed=1000,
        instruction="touch it",
        expert="oracle",
        expert_version=1,
        cue_steps=1,
        delay_steps=1,
        n_steps=len(actions),
        success_step=None,
        actions=encode_actions(actions),
        intended_actions=None,
        states_sha256="",
        images_sha256={},
    )


def test_a_mistyped_mode_or_the_dataset_s_own_is_one_message(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for mode, said in (
        ("pd_joint_po", "Did you mean 'pd_joint_pos'?"),
        (EE_DELTA_POSE, "its actions are for pd_ee_delta_pose already"),
    ):
        arguments = ["dataset", "convert", str(recorded), "--control-mode", mode, "--out", str(tmp_path)]
        assert main(arguments) == 1
        assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    "flag",
    [
        ("--task", "RememberColor3-v0"),
        ("--state", "joints"),
        ("--image-size", "64"),
        ("--image-size", "0"),
        ("--gripper", "0", "1"),
        ("--resample",),
        ("--clip-actions",),
    ],
)
def test_a_flag_that_another_mode_does_not_take_is_refused(
    flag: tuple[str, ...], recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mode = ("--control-mode", "pd_joint_pos")
    assert main(["dataset", "convert", str(recorded), *mode, *flag, "--out", str(tmp_path / "o")]) == 1
    assert f"{flag[0]}: --control-mode keeps all else of the recording" in capsys.readouterr().err
