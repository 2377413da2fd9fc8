"""Sessions on the simulated arm: every fault is an error, nothing is lost, and the rest is as without it."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from vla_eval.config.real_robot import SIMULATED
from vla_eval.envs.robot.faults import FAULTS
from vla_eval.envs.robot.link import RobotLink
from vla_eval.envs.robot.opening import open_robot
from vla_eval.envs.robot.robot_env import Station
from vla_eval.envs.robot.scripted import ScriptedOperator
from vla_eval.envs.robot.watch import StepClock
from vla_eval.errors import OperatorError, RecipeError, SpecMismatchError, TooManyErrorsError
from vla_eval.policies.entries import load_policy_entries
from vla_eval.real.evaluation import RealEvaluation
from vla_eval.real.session import Session
from vla_eval.records import EpisodeRecord
from vla_eval.storage.run_folder import read_run
from vla_eval.tasks.real_stages import stage_of

ERRORS = {
    "cable": "RobotBusError",
    "power": "RobotBusError",
    "camera": "RobotCameraError",
    "key": "OperatorError",
    "away": "OperatorError",
}
BLIND = dataclasses.replace(SIMULATED, lerobot={**SIMULATED.lerobot, "views": []}, response_seconds=2.0)
SEEING = dataclasses.replace(BLIND, lerobot=SIMULATED.lerobot, stale_frames=3)


@pytest.fixture(scope="module")
def arms() -> Any:
    """Arms by their settings, each made once."""
    made: dict[str, Any] = {}

    def of(settings: Any) -> Any:
        key = repr(settings)
        if key not in made:
            made[key] = open_robot(settings)
        made[key].disconnect()
        made[key].faults.clear()
        return made[key]

    yield of
    for arm in made.values():
        arm.close()


def evaluation(out: Path, *policies: str, **fields: Any) -> RealEvaluation:
    own = {"stages": (stage_of("CubesThrownIn"),), "episodes": 1, "seed": 0, "n_action_steps": 1}
    robot = fields.pop("settings", BLIND)
    return RealEvaluation(
        robot=robot, policies=load_policy_entries(policies or ("oracle",)), named_out=out, **{**own, **fields}
    )


def session(arm: Any, asked: RealEvaluation, **fields: Any) -> Session:
    link, settings = RobotLink(arm), asked.robot
    link.connect()
    station = Station.beside(link, fields.pop("operator", ScriptedOperator(arm)), settings, StepClock())
    return Session(evaluation=asked, station=station, say=lambda _: None, **fields)


def by_seed(out: Path) -> dict[int, EpisodeRecord]:
    return {one.seed: one for one in read_run(out).records}


def test_every_fault_can_be_rehearsed() -> None:
    assert ERRORS.keys() == FAULTS.keys()


def test_faults_are_errors_and_what_is_run_again_is_as_without_them(arms: Any, tmp_path: Path) -> None:
    """Three episodes, the first with a cable pulled, the third without an operator."""
    undisturbed = session(arms(BLIND), evaluation(tmp_path / "a")).run(command="")
    assert (undisturbed.n_episodes, undisturbed.n_open, undisturbed.n_errors) == (3, 0, 0)
    expected = by_seed(tmp_path / "a")

    arm = arms(BLIND)
    arm.faults.update({1: "cable", 3: "away"})
    asked = evaluation(tmp_path / "b")
    summary = session(arm, asked).run(command="")
    assert (summary.n_open, summary.n_errors) == (2, 2)
    found = by_seed(tmp_path / "b")
    for planned in asked.plan:
        record, fault = found[planned.trial.seed], {1: "cable", 3: "away"}.get(planned.trial.number)
        if fault is None:
            assert record == expected[planned.trial.seed]
        else:
            assert record.error is not None and record.error.kind == ERRORS[fault]

    assert session(arm, asked).run(command="").n_open == 0
    assert by_seed(tmp_path / "b") == expected
    lines = (tmp_path / "b" / "episodes.jsonl").read_text().splitlines()
    assert len(lines) == 5  # three results, and two errors that were run again


class Watching(ScriptedOperator):
    """Counts what the arm had been sent in an episode when its error was shown."""

    def __init__(self, arm: Any) -> None:
        super().__init__(arm)
        self.arm, self.n_sent = arm, dict[str, int]()

    def ask(self, words: str) -> None:
        self.n_sent[words.partition(" during")[0]] = len(self.arm.sent)
        super().ask(words)


@pytest.mark.parametrize("fault", ["power", pytest.param("key", marks=pytest.mark.slow)])
def test_after_a_fault_the_arm_is_sent_nothing_but_to_stay(fault: str, arms: Any, tmp_path: Path) -> None:
    arm = arms(BLIND)
    asked, operator = evaluation(tmp_path, stages=(stage_of("CubeVisible"),)), Watching(arm)
    running = session(arm, asked, operator=operator)
    arm.faults[1] = fault
    assert running.run(command="").n_errors == 1
    assert operator.n_sent[ERRORS[fault]] <= 3 + 1  # three steps until the fault, then at most one, to stay
    assert by_seed(tmp_path)[asked.plan[0].trial.seed].error is not None


@pytest.mark.slow
def test_a_frozen_camera_is_an_error_and_marks_come_with_images(arms: Any, tmp_path: Path) -> None:
    arm = arms(SEEING)
    asked = evaluation(tmp_path, settings=SEEING, stages=(stage_of("CubeVisible"),))
    operator = Watching(arm)
    running = session(arm, asked, operator=operator)
    arm.faults[1] = "camera"
    assert running.run(command="").n_errors == 1
    # From three steps on the image is that after two: at the fourth it comes for the third time
    # (stale_frames). So four commands, and one to stay.
    assert operator.n_sent == {"RobotCameraError": 4 + 1}
    for planned in asked.plan[1:]:
        names = [one.name for one in (tmp_path / "marks").glob(f"episode{planned.trial.number:04d}_*.png")]
        assert len(names) == 4 and not any("oracle" in name for name in names)
        assert sum("picked" in name for name in names) == 2  # of two cameras


def test_so_many_errors_in_a_row_end_the_session_and_keep_what_there_is(arms: Any, tmp_path: Path) -> None:
    arm = arms(BLIND)
    arm.faults.update(dict.fromkeys(range(2, 7), "key"))
    with pytest.raises(TooManyErrorsError, match=r"5 episodes in a row .* episode 6"):
        session(arm, evaluation(tmp_path, episodes=3)).run(command="")
    assert [one.outcome for one in read_run(tmp_path).records].count("error") == 5


def test_an_operator_who_says_no_after_an_error_ends_the_session(arms: Any, tmp_path: Path) -> None:
    class Refusing(ScriptedOperator):
        def ask(self, words: str) -> None:
            raise OperatorError("no")

    arm = arms(BLIND)
    arm.faults[1] = "key"
    with pytest.raises(OperatorError, match="no"):
        session(arm, evaluation(tmp_path), operator=Refusing(arm)).run(command="")
    assert [one.outcome for one in read_run(tmp_path).records] == ["error"]


def test_a_dry_run_commands_nothing_and_writes_nothing(arms: Any, tmp_path: Path) -> None:
    arm = arms(BLIND)
    lines = session(arm, evaluation(tmp_path / "new")).dry_run()
    assert any(line.startswith("motor gripper: ") for line in lines)
    assert arm.sent == [] and not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("policy", "words"), [("oracle", "true state of the world"), ("random", "moves at random")]
)
def test_what_no_real_arm_should_run_is_refused(policy: str, words: str, tmp_path: Path) -> None:
    real = dataclasses.replace(SIMULATED, lerobot={"type": "so101_follower"})
    with pytest.raises(SpecMismatchError, match=words):
        evaluation(tmp_path, policy, settings=real)


def test_a_policy_of_one_stage_needs_others_for_the_other_stages(tmp_path: Path) -> None:
    (entry,) = load_policy_entries(["random"])
    own = dataclasses.replace(entry, task="real_twin/CubesThrownIn-v0")
    both = (stage_of("CubesThrownIn"), stage_of("CubeVisible"))
    asked = evaluation(tmp_path, "random")
    with pytest.raises(RecipeError, match="expected one 'random' for CubeVisible, found 0"):
        dataclasses.replace(asked, policies=(own,), stages=both)
    dataclasses.replace(asked, policies=(own,))
