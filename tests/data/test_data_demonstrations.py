"""Attempts, manifest, checks and replay reports of demonstrations: what needs no process."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data.recorded_episodes import entry_of
from tests.data.replays import passed
from vla_eval.config.environment import EnvSettings
from vla_eval.core import EpisodeStart
from vla_eval.data.facts import read_facts
from vla_eval.data.manifest import (
    MIKASA_FOLDER,
    RECORDING_FILE,
    RecordedEpisode,
    ReplayReport,
    decode_actions,
    encode_actions,
    from_json,
    to_json,
)
from vla_eval.data.recording.demonstrations import (
    ONE_BY_ONE,
    Attempt,
    NoisyEnv,
    attempt,
    replay_actions,
    replay_attempt,
    states_digest,
)
from vla_eval.data.replay_report import keep_report
from vla_eval.data.replaying.episode_check import check_rows, check_states, psnr_db
from vla_eval.envs.fake import FakeEnv
from vla_eval.errors import DatasetError, RecordingError
from vla_eval.features import ACTION_KEY, PROPRIO_KEYS, SUCCESS_KEY, proprioception
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_oracle
from vla_eval.rollout import RolloutSettings

TASK = "RememberColor3-v0"
CAMERAS = ("base_camera", "hand_camera")


def make_env(*, cameras: tuple[str, ...] = ()) -> FakeEnv:
    return FakeEnv(EnvSettings(task=TASK, simulator="fake", privileged=True, cameras=cameras))


def start(seed: int, *, horizon_steps: int = 60) -> EpisodeStart:
    return EpisodeStart(
        slot=0, task=TASK, seed=seed, run=0, instruction="reach it", horizon_steps=horizon_steps
    )


def attempt_once(seed: int = 1000, *, noise: float = 0.0, steps_after_success: int = 5) -> Attempt:
    env = make_env()
    context = PolicyContext(name="oracle", env=env.spec, chunking=ONE_BY_ONE, n_candidates=3)
    settings = RolloutSettings(
        chunking=ONE_BY_ONE, stop_at_success=True, steps_after_success=steps_after_success
    )
    acting = NoisyEnv(env, noise) if noise else env
    return attempt(acting, make_oracle(context), start(seed), settings, heartbeat=lambda _stage: None)


class TestManifest:
    def test_actions_are_kept_exactly(self) -> None:
        actions = np.random.default_rng(0).normal(size=(5, 7)).astype(np.float32)
        assert np.array_equal(decode_actions(encode_actions(actions), n_dims=7), actions)

    def test_damaged_actions_are_an_error(self) -> None:
        with pytest.raises(DatasetError, match="expected base64 of float32 rows of 7"):
            decode_actions("AAAA", n_dims=7)

    def test_an_entry_comes_back_as_it_was_written(self) -> None:
        episode = entry_of(attempt_once())
        assert from_json(RecordedEpisode, to_json(episode), where="test") == episode

    def test_another_version_is_refused(self) -> None:
        text = to_json(entry_of(attempt_once())).replace('"format_version": 1', '"format_version": 2')
        with pytest.raises(DatasetError, match="format version 2, this program reads version 1"):
            from_json(RecordedEpisode, text, where="test")

    def test_a_folder_without_the_mark_of_completeness_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / MIKASA_FOLDER).mkdir(parents=True)
        with pytest.raises(
            DatasetError, match=f"{RECORDING_FILE}.*not a dataset that `mikasa-vla record` has"
        ):
            read_facts(tmp_path)


class TestDemonstrations:
    def test_an_attempt_ends_some_steps_after_success(self) -> None:
        one = attempt_once(steps_after_success=3)
        assert one.success_step is not None
        assert one.n_steps == one.success_step + 3 == len(decode_actions(one.actions, n_dims=7))
        assert (one.cue_steps, one.delay_steps) == (5, 5)
        assert one.intended_actions is None

    def test_the_same_actions_lead_to_the_same_states_with_pictures(self) -> None:
        one = attempt_once()
        env = make_env(cameras=CAMERAS)

        log = replay_attempt(env, start(1000, horizon_steps=one.n_steps), one, heartbeat=lambda _stage: None)

        assert states_digest(log.results) == one.states_sha256
        assert env.n_renders == one.n_steps  # none of the observation after the last action
        assert all(set(result.observation.images) == set(CAMERAS) for result in log.results[:-1])

    def test_other_states_are_an_error(self) -> None:
        one = dataclasses.replace(attempt_once(), states_sha256="0" * 64)
        with pytest.raises(RecordingError, match="seed 1000: expected the same actions to lead to the same"):
            replay_attempt(
                make_env(cameras=CAMERAS),
                start(1000, horizon_steps=one.n_steps),
                one,
                heartbeat=lambda _stage: None,
            )

    def test_noise_pushes_the_arm_and_not_the_gripper_and_the_expert_corrects_it(self) -> None:
        one, again, clean = attempt_once(noise=0.1), attempt_once(noise=0.1), attempt_once()
        assert one == again  # noise is the episode's own
        assert one.intended_actions is not None
        executed, intended = (
            decode_actions(one.actions, n_dims=7),
            decode_actions(one.intended_actions, n_dims=7),
        )
        assert np.array_equal(executed[:, -1], intended[:, -1])
        assert (executed[:, :6] != intended[:, :6]).any(axis=0).all()
        assert np.abs(executed).max() <= 1
        assert one.success_step is not None
        assert not np.array_equal(
            intended[: clean.n_steps], decode_actions(clean.actions, n_dims=7)[: one.n_steps]
        )


class TestEpisodeCheck:
    def log_and_rows(self, one: Attempt) -> tuple[Any, dict[str, Any]]:
        actions = decode_actions(one.actions, n_dims=7)
        log = replay_actions(
            make_env(),
            start(one.seed, horizon_steps=one.n_steps),
            actions,
            heartbeat=lambda _stage: None,
            with_pictures=False,
        )
        joints = [proprioception(result.observation.state)["joints"] for result in log.results[:-1]]
        return log, {
            ACTION_KEY: actions,
            SUCCESS_KEY: np.array([result.status.success for result in log.results[1:]]),
            PROPRIO_KEYS["joints"]: np.stack(joints),
        }

    def test_what_agrees_is_not_mentioned(self) -> None:
        one = attempt_once()
        log, rows = self.log_and_rows(one)
        assert check_rows(entry_of(one), rows, log) == []
        assert check_states(entry_of(one), rows, log, expect_equal_bits=True) == []

    def test_a_changed_action_is_found(self) -> None:
        one = attempt_once()
        log, rows = self.log_and_rows(one)
        rows[ACTION_KEY] = rows[ACTION_KEY].copy()
        rows[ACTION_KEY][3, 2] += 1e-6
        assert check_rows(entry_of(one), rows, log) == [
            "the actions of the table are not those of the manifest"
        ]

    def test_states_that_differ_in_the_last_bits_pass_on_another_machine_only(self) -> None:
        one = dataclasses.replace(attempt_once(), states_sha256="0" * 64)
        log, rows = self.log_and_rows(one)
        rows[PROPRIO_KEYS["joints"]][4, 1] += 1e-3
        assert check_states(entry_of(one), rows, log, expect_equal_bits=False) == []
        (sentence,) = check_states(entry_of(one), rows, log, expect_equal_bits=True)
        assert sentence == "states differ, most by 0.001 in y at step 4"

    def test_states_that_differ_by_more_than_the_tolerance_never_pass(self) -> None:
        one = dataclasses.replace(attempt_once(), states_sha256="0" * 64)
        log, rows = self.log_and_rows(one)
        rows[PROPRIO_KEYS["joints"]][4, 1] += 0.02
        assert len(check_states(entry_of(one), rows, log, expect_equal_bits=False)) == 1

    def test_a_success_that_is_gone_is_found(self) -> None:
        one = attempt_once()
        log, rows = self.log_and_rows(one)
        (sentence,) = check_states(
            entry_of(dataclasses.replace(one, success_step=None)), rows, log, expect_equal_bits=True
        )
        assert sentence == f"first success at step {one.success_step}, expected at None"

    def test_psnr_by_hand(self) -> None:
        black = np.zeros((2, 2, 3), dtype=np.uint8)
        # 20 log10(255 / 5) = 34.15
        assert psnr_db(black, black + np.uint8(5)) == pytest.approx(34.151, abs=1e-3)
        assert psnr_db(black, black) == 100


class TestReplayReport:
    def report(self, dataset: Path, **fields: Any) -> ReplayReport:
        from vla_eval.data.replay_report import manifest_sha256

        default = ReplayReport(
            passed=True,
            n_episodes=2,
            n_total=2,
            pixels=False,
            states_compared="bit-equal",
            mismatches=(),
            lowest_psnr_db={},
            manifest_sha256=manifest_sha256(dataset),
        )
        return dataclasses.replace(default, **fields)

    @pytest.fixture
    def dataset(self, tmp_path: Path) -> Path:
        (tmp_path / MIKASA_FOLDER).mkdir(parents=True)
        (tmp_path / MIKASA_FOLDER / "manifest.jsonl").write_text("{}\n")
        return tmp_path

    def test_a_dataset_that_was_never_replayed_has_no_report(self, dataset: Path) -> None:
        assert passed(dataset) is None

    def test_a_failed_replay_is_refused_with_its_mismatches(self, dataset: Path) -> None:
        keep_report(dataset, self.report(dataset, passed=False, mismatches=("episode 1: gone",)))
        with pytest.raises(DatasetError, match=r"failed with 1 mismatches:\n  episode 1: gone"):
            passed(dataset)

    def test_a_part_that_passes_does_not_stand_for_the_whole(self, dataset: Path) -> None:
        keep_report(dataset, self.report(dataset, n_episodes=1))
        assert passed(dataset) is None

    def test_a_mismatch_of_pictures_is_not_hidden_by_a_replay_that_looks_at_none(self, dataset: Path) -> None:
        keep_report(dataset, self.report(dataset, passed=False, pixels=True, mismatches=("pale",)))
        keep_report(dataset, self.report(dataset))
        with pytest.raises(DatasetError, match="pale"):
            passed(dataset)
        keep_report(dataset, self.report(dataset, pixels=True))
        assert passed(dataset) is not None

    def test_a_report_about_another_manifest_is_refused(self, dataset: Path) -> None:
        keep_report(dataset, self.report(dataset))
        (dataset / MIKASA_FOLDER / "manifest.jsonl").write_text("{}\n{}\n")
        with pytest.raises(DatasetError, match="is about another manifest"):
            passed(dataset)
