"""Lines of progress for other programs: what they hold, and that their reader cannot hurt the run."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from vla_eval.chunking import ChunkingSpec
from vla_eval.cli.main import main
from vla_eval.cli.terminal.json_progress import EvaluationLines, JsonLines, PhaseLines
from vla_eval.config.environment import EnvSettings
from vla_eval.envs.factory import describe_env
from vla_eval.evaluation.episode_jobs import EpisodeGroup, EpisodeJob, GroupKey
from vla_eval.evaluation.plan import Plan
from vla_eval.records import EpisodeError, EpisodeRecord
from vla_eval.rollout import RolloutSettings
from vla_eval.workers.load import Load, MachineLoad

HORIZON_STEPS = 60


class Reader:
    """A pipe whose other end is a `JsonLines` with a clock that the test moves."""

    def __init__(self) -> None:
        self._read, self.write = os.pipe()
        self.seconds = 0.0
        self.lines = JsonLines(self.write, clock=lambda: self.seconds)

    def read(self) -> list[dict[str, Any]]:
        os.set_blocking(self._read, False)
        try:
            text = os.read(self._read, 1 << 16).decode()
        except BlockingIOError:
            return []
        return [json.loads(line) for line in text.splitlines()]

    def close_reader(self) -> None:
        os.close(self._read)


def plan(n_episodes: int) -> Plan:
    env = EnvSettings(task="RememberColor3-v0", kwargs={"horizon_steps": HORIZON_STEPS})
    group = EpisodeGroup(
        key=GroupKey("RememberColor3-v0", "p", 1),
        adapter="hold",
        args={},
        env=env,
        offered=describe_env(env),
        n_candidates=3,
        rollout=RolloutSettings(chunking=ChunkingSpec(n_action_steps=1)),
        instruction="i",
    )
    return Plan(
        jobs=tuple(EpisodeJob(group=group, run=0, seed=seed) for seed in range(n_episodes)),
        recipe_hashes={},
        normalization={},
        servers={},
        task_versions={},
        sentences={},
        training_seeds={},
        policy_names=("p",),
        shared={},
        left_out=(),
        max_workers=None,
    )


def record(seed: int, n_steps: int) -> EpisodeRecord:
    return EpisodeRecord(
        task="RememberColor3-v0",
        policy="p",
        n_action_steps=1,
        run=0,
        seed=seed,
        outcome="success",
        success_once=True,
        n_steps=n_steps,
    )


def test_an_episode_that_ends_early_leaves_fewer_steps_and_time_is_known_from_the_first_on(
    tmp_path: Path,
) -> None:
    reader = Reader()
    lines = EvaluationLines(reader.lines, out=tmp_path)

    lines.on_start(plan(4), n_finished=0, n_workers=2)
    (begin,) = reader.read()
    assert (begin["format_version"], begin["event"], begin["run"]) == (1, "begin", str(tmp_path))
    assert (begin["episodes_done"], begin["episodes_total"], begin["workers"]) == (0, 4, 2)
    assert (begin["steps_done"], begin["steps_total"]) == (0, 4 * HORIZON_STEPS)
    assert begin["remaining_seconds"] is None

    reader.seconds = 10.0
    lines.on_record(record(0, n_steps=20))
    lines.on_tick()
    (progress,) = reader.read()
    assert progress["event"] == "progress"
    # 20 steps instead of 60; 1 episode in 10 s, so 3 more in 30 s.
    assert (progress["steps_done"], progress["steps_total"]) == (20, 200)
    assert (progress["successes"], progress["errors"]) == (1, 0)
    assert (progress["elapsed_seconds"], progress["remaining_seconds"]) == (10.0, 30.0)


def test_a_line_has_the_steps_under_way_the_queue_and_the_machines_of_a_cluster(tmp_path: Path) -> None:
    reader = Reader()
    lines = EvaluationLines(reader.lines, out=tmp_path)
    lines.on_start(plan(4), n_finished=0, n_workers=2)
    (begin,) = reader.read()
    assert (begin["steps_running"], begin["queue"], begin["machines"]) == (None, None, None)

    lines.on_record(record(0, n_steps=20))
    lines.on_load(Load(n_running=2, n_counted=31))
    reader.seconds = 2.0
    lines.on_tick()
    (progress,) = reader.read()
    # Of 4 episodes one has a result and two are running.
    assert (progress["steps_running"], progress["queue"], progress["machines"]) == (31, 1, None)

    one = MachineLoad(
        name="a", is_used=True, n_workers=1, n_running=1, n_done=1, per_second=0.5, n_gpus=1, gpu_share=0.25
    )
    lines.on_load(Load(n_running=1, machines=(one,)))
    reader.seconds = 4.0
    lines.on_tick()
    (progress,) = reader.read()
    assert (progress["steps_running"], progress["queue"]) == (None, 2)
    assert progress["machines"] == [
        {
            **{"name": "a", "is_used": True, "n_workers": 1, "n_running": 1, "n_done": 1},
            **{"per_second": 0.5, "n_gpus": 1, "gpu_share": 0.25},
        }
    ]


def test_there_is_at_most_one_line_of_progress_per_second(tmp_path: Path) -> None:
    reader = Reader()
    lines = EvaluationLines(reader.lines, out=tmp_path)
    lines.on_start(plan(4), n_finished=0, n_workers=1)
    for reader.seconds in (0.4, 0.8, 1.2, 1.6, 2.0, 2.4):
        lines.on_tick()

    # After 1.2 s and after 2.4 s.
    assert [line["event"] for line in reader.read()] == ["begin", "progress", "progress"]


def test_an_error_has_a_line_of_its_own_and_its_steps_are_still_to_do(tmp_path: Path) -> None:
    reader = Reader()
    lines = EvaluationLines(reader.lines, out=tmp_path)
    lines.on_start(plan(1), n_finished=0, n_workers=1)
    failed = EpisodeError(kind="WorkerCrashed", stage="step", message="gone", details="long")
    lines.on_record(
        EpisodeRecord(
            task="RememberColor3-v0",
            policy="p",
            n_action_steps=1,
            run=0,
            seed=0,
            outcome="error",
            error=failed,
        )
    )
    lines.close(stopped=True)

    _, error, end = reader.read()
    assert (error["event"], error["episode"]["seed"], error["kind"]) == ("error", 0, "WorkerCrashed")
    assert "details" not in error
    assert (end["event"], end["stopped"], end["errors"]) == ("end", True, 1)
    assert (end["steps_done"], end["steps_total"]) == (0, HORIZON_STEPS)


def test_each_phase_of_a_recording_begins_and_ends_and_says_null_of_what_it_does_not_know() -> None:
    reader = Reader()
    lines = PhaseLines(reader.lines)
    lines.on_phase("T", "trying seeds", n_done=0, n_total=2)
    lines.on_progress(n_done=2)
    lines.on_phase("T", "rendering", n_done=1, n_total=2)
    lines.close(stopped=False)
    lines.close(stopped=False)

    found = [(line["phase"], line["event"], line["episodes_done"]) for line in reader.read()]
    assert found == [
        ("trying seeds", "begin", 0),
        ("trying seeds", "end", 2),
        ("rendering", "begin", 1),
        ("rendering", "end", 1),
    ]


def test_a_reader_that_is_gone_does_not_stop_the_run() -> None:
    reader = Reader()
    reader.close_reader()
    lines = PhaseLines(reader.lines)

    lines.on_phase("T", "rendering", n_done=0, n_total=1)
    lines.on_mismatch("m")
    lines.close(stopped=False)


@pytest.mark.parametrize("text", ["0", "1", "-1", "x", "987654", "9" * 30])
def test_what_is_no_open_descriptor_is_a_mistake(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["eval", "demo", f"--json-progress={text}"])

    assert stopped.value.code == 1
    assert (
        "argument --json-progress: expected the number of an open file descriptor" in capsys.readouterr().err
    )


def test_on_standard_error_the_lines_take_the_place_of_the_bar(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    command = ["eval", "--task", "RememberColor3-v0", "--policy", "hold", "--episodes", "1", "--workers", "1"]
    command += ["--set", "simulator=fake", "--set", "env.horizon_steps=12", "--out", str(tmp_path / "out")]

    assert main([*command, "--json-progress", "2"]) == 0
    assert main([*command, "--json-progress", "2"]) == 0

    captured = capfd.readouterr()
    assert "| policy" in captured.out
    lines = [json.loads(line) for line in captured.err.splitlines()]
    assert [line["event"] for line in lines if line["event"] != "progress"] == ["begin", "end"] * 2
    # The second time, all is there: the steps are those of the stored record.
    assert (lines[-1]["episodes_done"], lines[-1]["steps_done"], lines[-1]["steps_total"]) == (1, 12, 12)
    assert lines[-1]["remaining_seconds"] == 0.0
