"""Demonstrations on an arm: what is stored of them, and that nothing is lost, invented or moved unasked."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.real.recording_bench import ANSWER_STEPS, FakeLeader, Person, Recording
from vla_eval.data.facts import ArmFacts
from vla_eval.data.manifest import FAILED_FILE, DiscardedTrial, read_entries
from vla_eval.data.opening import open_dataset
from vla_eval.data.recording.arm import StageRecording
from vla_eval.errors import DatasetError, RecordingError, RunChangedError, TooManyErrorsError
from vla_eval.real.demonstrations import Demonstrations
from vla_eval.real.plan import demonstration_trials, make_plan
from vla_eval.tasks.real_stages import COLORS, STAGES, stage_of

TASK = "real/CubesThrownIn-v0"


def facts_of(out: Path, task: str = TASK) -> ArmFacts:
    facts = open_dataset(out / task).facts
    assert isinstance(facts, ArmFacts)
    return facts


def test_a_stage_becomes_a_dataset_of_motors_with_its_phases(tmp_path: Path) -> None:
    stages = (stage_of("CubeVisible"), stage_of("CubesThrownIn"))
    Recording(tmp_path, stages=stages).run()
    dataset = open_dataset(tmp_path / TASK)
    facts, columns = facts_of(tmp_path), dataset.columns
    assert (facts.state, facts.control_mode, facts.leader, facts.robot) == (
        *("motors", "motors", "fake_leader"),
        "fake_arm",
    )
    assert dataset.meta.fps == 10 and dataset.meta.robot_type == "fake_arm"
    assert dataset.cameras == ("observation.images.front",)
    names = ["pan.pos", "lift.pos", "gripper.pos"]
    assert dataset.meta.features["action"]["names"] == names
    assert dataset.meta.features["observation.state"]["names"] == names
    assert {one.color for one in facts.episodes} == set(COLORS)
    # Pressed in the second control step, the response begins with its observation; that step is held, too.
    # Then so many steps without a key, and one at which the mark is read.
    n_steps = 2 + ANSWER_STEPS + 1
    for episode in facts.episodes:
        assert (episode.n_steps, episode.success_step) == (n_steps, n_steps)
        assert (episode.cue_steps, episode.delay_steps, episode.touched) == (2, 0, (episode.color,))
    first = columns["episode_index"] == 0
    success = columns["next.success"][first].reshape(-1)
    assert success.tolist() == columns["next.done"][first].reshape(-1).tolist() == [False] * 5 + [True]
    said = {one.instruction for one in facts_of(tmp_path, "real/CubeVisible-v0").episodes}
    assert said == {f"Pick the {color} cube" for color in COLORS}


def test_a_stage_that_is_finished_is_not_recorded_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = (stage_of("CubeVisible"), stage_of("CubesThrownIn"))
    join = StageRecording.join

    def killed(store: StageRecording, *args: Any) -> ArmFacts:
        if store.task == TASK:
            raise KeyboardInterrupt
        return join(store, *args)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(StageRecording, "join", killed)
        Recording(tmp_path, stages=stages).run()
    finished = facts_of(tmp_path, "real/CubeVisible-v0")

    again = Recording(tmp_path, stages=stages)
    again.run()

    assert again.person.trials == []
    assert facts_of(tmp_path, "real/CubeVisible-v0") == finished
    assert len(facts_of(tmp_path).episodes) == len(COLORS)


def test_the_arm_is_held_and_then_comes_to_the_leader_by_steps(tmp_path: Path) -> None:
    recording = Recording(tmp_path, leader=FakeLeader(99.0, -20.0, 52.0))
    recording.run()
    columns = open_dataset(tmp_path / TASK).columns
    rows = columns["action"][columns["episode_index"] == 0]
    # From (10, -20, 50), by at most max_step = 5; the reveal's control step is held.
    assert rows[:, 0].tolist() == [10, 10, 15, 20, 25, 30]
    assert rows[:, 1].tolist() == [-20] * 6 and rows[:, 2].tolist() == [50, 50, 52, 52, 52, 52]
    state = columns["observation.state"][columns["episode_index"] == 0]
    assert state[:, 0].tolist() == [10, 10, 10, 15, 20, 25]  # before each action
    told = [line for line in recording.person.told if line.startswith("The leader")]
    assert told[0] == (
        "The leader is up to 89.0 from the arm (pan). The arm comes to it by at most 5 per control step."
    )
    assert len(told) == 3  # once per episode: on the way home, nothing follows the leader


def test_what_was_not_picked_is_discarded_and_replaced(tmp_path: Path) -> None:
    recording = Recording(tmp_path, person=Person(fails=(1,)))
    recording.run()
    facts, trials = facts_of(tmp_path), recording.person.trials
    assert len(trials) == 3 + 1 and facts.n_discarded == 1
    assert [one.number for one in read_entries(tmp_path / TASK / FAILED_FILE, DiscardedTrial)] == [
        trials[1].number
    ]
    assert [one.number for one in facts.episodes] == [trials[i].number for i in (0, 2, 3)]
    assert sorted(one.color for one in facts.episodes) == sorted(COLORS)
    assert any("Discarded" in line for line in recording.person.told)


@pytest.mark.slow
def test_all_can_be_kept(tmp_path: Path) -> None:
    Recording(tmp_path, person=Person(fails=(1,)), keep="all").run()
    dataset = open_dataset(tmp_path / TASK)
    assert [one.success_step is None for one in facts_of(tmp_path).episodes] == [False, True, False]
    assert dataset.failed == (1,)


@pytest.mark.slow
def test_a_leader_that_never_succeeds_ends_the_recording(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="10 episodes in a row"):
        Recording(tmp_path, person=Person(fails=range(99))).run()


def test_a_fault_is_recorded_again_and_the_arm_stays(tmp_path: Path) -> None:
    recording = Recording(tmp_path)
    recording.leader.n_reads_to_fault = 4  # the first is that of the message, the fourth after two commands
    recorded = recording.run()
    assert recorded.n_errors == 1 and recording.leader.n_connected == 2
    assert [one.number for one in recording.person.trials] == [1, 1, 2, 3]
    assert len(facts_of(tmp_path).episodes) == 3
    # Two control steps of the cue, two of the response, then one command to stay where the arm was seen.
    assert recording.arm.sent[4] == recording.arm.sent[3]


def test_a_leader_that_cannot_be_disconnected_any_more_is_connected_again(tmp_path: Path) -> None:
    leader = FakeLeader(99.0, 99.0, 99.0)
    leader.n_reads_to_fault, leader.is_gone = 4, True
    recorded = Recording(tmp_path, leader=leader).run()
    assert recorded.n_errors == 1 and leader.n_connected == 2


def test_too_many_faults_in_a_row_end_it(tmp_path: Path) -> None:
    recording = Recording(tmp_path)
    recording.arm.changes = {"front": None}
    with pytest.raises(TooManyErrorsError, match="5 episodes in a row"):
        recording.run()


class Killed(Person):
    """Is interrupted in the middle of the second episode."""

    def pressed(self) -> Any:
        if len(self.trials) == 2 and len(self.waiting) == 2:
            raise KeyboardInterrupt
        return super().pressed()


def test_what_was_recorded_before_a_kill_stays_and_the_rest_follows(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        Recording(tmp_path, person=Killed()).run()
    shards = tmp_path / "recording" / TASK / "shards"
    assert [path.name for path in shards.iterdir()] == ["shard-00001"]
    (shards / "shard-00002.1.draft").mkdir()  # what kill -9 leaves
    again = Recording(tmp_path)
    again.run()
    assert [one.number for one in again.person.trials] == [2, 3]
    assert [one.number for one in facts_of(tmp_path).episodes] == [1, 2, 3]
    assert not shards.exists()
    last = Recording(tmp_path)
    assert len(last.run().datasets) == 1 and last.person.trials == []


@pytest.mark.slow
def test_fewer_episodes_end_a_recording_early_and_more_do_not_change_a_dataset(tmp_path: Path) -> None:
    class Tired(Person):
        def prepare(self, trial: Any) -> None:
            if len(self.trials) == 4:
                raise KeyboardInterrupt
            super().prepare(trial)

    with pytest.raises(KeyboardInterrupt):
        Recording(tmp_path, person=Tired(), episodes=3).run()
    Recording(tmp_path, episodes=1).run()
    assert len(facts_of(tmp_path).episodes) == 3
    with pytest.raises(RecordingError, match=r"expected 6 episodes, found a finished dataset of 3"):
        Recording(tmp_path, episodes=2).run()


@pytest.mark.slow
def test_another_arm_or_order_needs_another_folder(tmp_path: Path) -> None:
    Recording(tmp_path).run()
    with pytest.raises(RunChangedError, match="plan_seed"):
        Recording(tmp_path, seed=1).run()


def test_a_dry_run_commands_nothing_and_writes_nothing(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "new")
    lines = recording.session.dry_run()
    assert "leader pan: 99.0" in lines and any(line.startswith("motor pan: 10.0") for line in lines)
    assert recording.arm.sent == [] and not (tmp_path / "new").exists()


def test_demonstrations_are_of_no_trial_of_an_evaluation() -> None:
    evaluated = {one.trial.seed for one in make_plan(["a"], STAGES, episodes=1000, seed=0)}
    trials = demonstration_trials(STAGES, seed=0)
    assert not evaluated & {next(trials).seed for _ in range(1000)}


@pytest.mark.parametrize("n_fails", range(4))
def test_whatever_is_discarded_every_stage_and_color_gets_its_number(n_fails: int, tmp_path: Path) -> None:
    """Drawn outcomes: the trials used are the first ones that were kept, of each row as many as asked."""
    asked = Demonstrations(
        robot=Recording(tmp_path / "unused").asked.robot, leader="l", stages=STAGES, episodes=3, seed=n_fails
    )
    draws = np.random.default_rng(n_fails)
    kept: dict[str, set[int]] = {stage.name: set() for stage in STAGES}
    tried: set[int] = set()
    while (found := asked.chosen(kept, tried))[1] is not None:
        trial = found[1]
        (tried if draws.random() < n_fails / 5 else kept[trial.stage.name]).add(trial.number)
    used = found[0]
    rows = [(trial.stage.name, trial.color) for trial in used]
    assert len(used) == 27 and all(rows.count(row) == 3 for row in set(rows)) and len(set(rows)) == 9
    assert [trial.number for trial in used] == sorted(trial.number for trial in used)


@pytest.mark.slow
def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    Recording(tmp_path).run()
    path = next((tmp_path / TASK).glob("data/*/*.parquet"))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DatasetError, match="Fetch the dataset again"):
        open_dataset(tmp_path / TASK)
