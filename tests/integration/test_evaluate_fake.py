"""Whole runs on the fake simulator: faults, timeouts, kills, resume; no fault touches another episode."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest

from vla_eval import evaluate as evaluate_module
from vla_eval.cli.main import main
from vla_eval.decoding import decode
from vla_eval.errors import (
    RecipeError,
    RunChangedError,
    SpecMismatchError,
    TooManyErrorsError,
)
from vla_eval.evaluate import EvaluationSummary, default_run_folder, evaluate
from vla_eval.recipes import EvalConfig
from vla_eval.results.records import EpisodeRecord
from vla_eval.results.store import read_run

TASK = "RememberColor3-v0"
HANGS_AFTER_S = 240.0
"""Far longer than anything here takes on a slow machine: what is not over by then never will be."""
SHORT = {"horizon_steps": 12, "cue_steps": 1, "delay_steps": 1}  # so that an episode takes a millisecond

# A policy that does, at the seeds it is told to, what policies and machines do at night. A file named
# `mended` beside it makes it behave: as if its author had corrected it, the recipe being the same.
POLICY_MODULE = """
import os, signal, sys, time
from pathlib import Path
import numpy as np
from vla_eval.core import ActionChunk
from vla_eval.errors import SpecMismatchError
from vla_eval.specs import PolicySpec

HERE = Path(__file__).parent


class Policy:
    def __init__(self, context, faults, pause, cameras):
        (HERE / f"pid-{os.getpid()}").touch()
        if faults.get("setup") and not (HERE / "mended").exists():
            self.fault(faults["setup"])
        self.spec = PolicySpec(name="whatever", reads="last", cameras=tuple(cameras), states=("qpos",),
                               chunk_size=context.chunking.min_chunk_size)
        self.faults, self.pause, self.seed = faults, pause, None

    def reset(self, episodes):
        (episode,) = episodes
        self.seed, self.run = episode.seed, episode.run
        self.rng = np.random.default_rng([episode.seed, episode.run])

    def act(self, window):
        time.sleep(self.pause)
        fault = self.faults.get(str(self.seed))
        if fault and window.last.step >= 2 and not (HERE / "mended").exists():
            answer = self.fault(fault)
            if answer is not None:
                return answer
        drawn = self.rng.uniform(-1, 1, (self.spec.chunk_size, 7))
        return ActionChunk(actions=drawn.astype(np.float32))

    def fault(self, kind):
        shape = (self.spec.chunk_size, 7) if kind in ("nan", "shape") else None
        if kind == "exit":
            print("these are my last words", file=sys.stderr, flush=True)
            os._exit(7)
        if kind == "segfault":
            os.kill(os.getpid(), signal.SIGSEGV)
        if kind == "hang":
            time.sleep(1000)
        if kind == "sysexit":
            sys.exit("bye")
        if kind == "refuse once it has run" and (HERE / "ran").exists():
            raise SpecMismatchError("the GPU is gone")
        if kind == "refuse once it has run":
            return
        (HERE / "ran").touch()
        if kind == "raise":
            raise ZeroDivisionError("a mistake in the policy")
        if kind == "nan":
            return ActionChunk(actions=np.full(shape, np.nan, dtype=np.float32))
        if kind == "shape":
            return ActionChunk(actions=np.zeros((shape[0], 6), dtype=np.float32))


def make(context, *, faults={}, pause=0.0, cameras=()):
    return Policy(context, faults, pause, cameras)
"""

# Counts its inferences and draws numbers, each slot its own: what would show if episodes mixed.
PAIR_MODULE = """
from pathlib import Path
import numpy as np
from vla_eval.core import ActionChunk
from vla_eval.specs import PolicySpec

HERE = Path(__file__).parent


class Policy:
    def __init__(self, context, fails_at):
        self.spec = PolicySpec(name="pair", reads="last", cameras=(), states=("qpos",),
                               chunk_size=context.chunking.min_chunk_size)
        self.fails_at, self.slots = fails_at, {}

    def reset(self, episodes):
        for e in episodes:
            self.slots[e.slot] = {"seed": e.seed, "n": 0, "rng": np.random.default_rng([e.seed, e.run])}

    def act_batch(self, windows):
        with (HERE / "passes").open("a") as file:
            file.write(f"{len(windows)} ")
        return [self.act(window) for window in windows]

    def act(self, window):
        slot = self.slots[window.slot]
        slot["n"] += 1
        if slot["seed"] == self.fails_at and not (HERE / "mended").exists():
            raise ZeroDivisionError("a mistake in the policy")
        actions = slot["rng"].uniform(-1, 1, (self.spec.chunk_size, 7)).astype(np.float32)
        actions[:, 0] = 0.1 * slot["n"]
        return ActionChunk(actions=actions)


def make(context, *, fails_at=None):
    return Policy(context, fails_at)
"""


class Bench:
    """A folder with the policy's module, its recipe, and what is needed to run it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "night_policy.py").write_text(POLICY_MODULE)
        (folder / "pair_policy.py").write_text(PAIR_MODULE)
        self.write_policy()

    def write_policy(self, adapter: str = "night_policy:make", **args: Any) -> None:
        recipe = {"version": 1, "description": "d", "adapter": adapter, "args": args}
        (self.folder / "night.yaml").write_text(json.dumps(recipe))  # JSON is YAML

    def mend(self) -> None:
        (self.folder / "mended").touch()

    def config(self, **fields: Any) -> EvalConfig:
        data = {
            "name": "test",
            "tasks": [TASK],
            "policies": [str(self.folder / "night.yaml")],
            "episodes": 6,
            "simulator": "fake",
            "env": SHORT,
            "workers": 1,
            **fields,
        }
        return decode(EvalConfig, data, where="test")

    def run(self, out: str, **fields: Any) -> EvaluationSummary:
        return evaluate(self.config(**fields), out=self.folder / out)

    def records(self, out: str) -> dict[int, EpisodeRecord]:
        return {record.seed: record for record in read_run(self.folder / out).records}

    def lines(self, out: str) -> list[str]:
        """Return the lines of all results, sorted; those of errors are left out."""
        lines = (self.folder / out / "episodes.jsonl").read_text().splitlines()
        return sorted(line for line in lines if '"outcome": "error"' not in line)

    def worker_pids(self) -> set[int]:
        return {int(path.name.removeprefix("pid-")) for path in self.folder.glob("pid-*")}


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.syspath_prepend(tmp_path)  # spawned workers get the parent's path
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)  # and so do command lines
    monkeypatch.setattr(evaluate_module, "collect_environment", lambda: {"machine": "test"})
    return Bench(tmp_path)


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def wait_until(claim: Callable[[], bool], *, seconds: float = HANGS_AFTER_S) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if claim():
            return True
        time.sleep(0.02)
    return claim()


# ------------------------------------------------------------------------------------------ side by side


class TestSlots:
    def test_records_do_not_depend_on_how_many_episodes_run_side_by_side(self, bench: Bench) -> None:
        bench.write_policy("pair_policy:make")

        bench.run("alone", runs=2)
        bench.run("beside", runs=2, slots_per_worker=4)

        assert len(bench.lines("alone")) == 12
        assert bench.lines("beside") == bench.lines("alone")
        # 12 control steps each: 12 episodes one by one; then, per run, 4 side by side and 2 side by side.
        passes = (bench.folder / "passes").read_text().split()
        assert passes == ["1"] * 12 * 12 + (["4"] * 12 + ["2"] * 12) * 2

    def test_an_error_is_the_error_of_one_episode_and_not_of_its_neighbours(self, bench: Bench) -> None:
        bench.write_policy("pair_policy:make")
        bench.run("alone")
        bench.write_policy("pair_policy:make", fails_at=3)

        summary = bench.run("beside", slots_per_worker=4)

        records = bench.records("beside")
        assert (summary.n_errors, summary.n_open) == (1, 1)
        assert {seed for seed, record in records.items() if record.error is not None} == {3}
        bench.mend()
        assert bench.run("beside", slots_per_worker=4).n_open == 0
        assert bench.lines("beside") == bench.lines("alone")

    def test_a_run_is_not_continued_with_another_number_of_slots(self, bench: Bench) -> None:
        bench.run("out")
        with pytest.raises(RunChangedError, match="slots_per_worker"):
            bench.run("out", slots_per_worker=2)


# ------------------------------------------------------------------------------------------ faults


class TestFaults:
    FAULTS: ClassVar = {
        "2": "exit",
        "3": "segfault",
        "4": "hang",
        "5": "nan",
        "6": "shape",
        "7": "raise",
        "8": "sysexit",
    }

    def test_each_fault_is_an_error_with_its_cause_and_touches_no_other_episode(self, bench: Bench) -> None:
        bench.write_policy(faults=self.FAULTS)
        fields: dict[str, Any] = {"episodes": 9, "workers": 2, "timeouts": {"inference_seconds": 5.0}}

        summary = bench.run("out", **fields)

        records = bench.records("out")
        errors = {seed: record.error for seed, record in records.items() if record.error is not None}
        assert (summary.n_errors, summary.n_open, len(records)) == (7, 7, 9)
        assert {seed: error.kind for seed, error in errors.items()} == {
            2: "WorkerCrashed",
            3: "WorkerCrashed",
            4: "InferenceTimeout",
            5: "InvalidActionError",
            6: "InvalidActionError",
            7: "ZeroDivisionError",
            8: "SystemExit",
        }
        assert all(error.stage == "inference" for error in errors.values())
        assert "exited with code 7" in errors[2].message
        assert "these are my last words" in (errors[2].details or "")
        assert "SIGSEGV" in errors[3].message
        assert "more than 5 s" in errors[4].message
        assert "timeouts.inference_seconds=10" in errors[4].message
        assert "in fault" in (errors[4].details or "")  # the stack of the hanging thread names the function
        assert "nan at row 0" in errors[5].message
        assert "shape (1, 6)" in errors[6].message
        assert 'raise ZeroDivisionError("a mistake in the policy")' in (errors[7].details or "")
        assert all(records[seed].outcome != "error" for seed in (1, 9))

        bench.mend()
        assert bench.run("out", **fields).n_open == 0
        bench.run("clean", **fields)
        assert bench.lines("out") == bench.lines("clean")

    def test_errors_in_a_row_stop_the_run_and_keep_the_records(self, bench: Bench) -> None:
        bench.write_policy(faults={str(seed): "raise" for seed in range(2, 7)})

        with pytest.raises(
            TooManyErrorsError, match=r"3 episodes in a row .*night .*seed 4: ZeroDivisionError"
        ):
            bench.run("out", max_consecutive_errors=3)

        assert [r.outcome == "error" for r in bench.records("out").values()] == [False, True, True, True]

    def test_a_hanging_setup_is_an_error(self, bench: Bench) -> None:
        bench.write_policy(faults={"setup": "hang"})

        summary = bench.run("out", episodes=1, timeouts={"setup_seconds": 3.0})

        error = bench.records("out")[1].error
        assert summary.n_errors == 1
        assert error is not None
        assert (error.kind, error.stage) == ("SetupTimeout", "setup")

    def test_a_refusal_of_what_has_worked_before_is_an_error_and_no_mistake(self, bench: Bench) -> None:
        bench.write_policy(faults={"setup": "refuse once it has run", "2": "raise"})

        with pytest.raises(
            TooManyErrorsError, match="seed 4: SpecMismatchError during setup: the GPU is gone"
        ):
            bench.run("out", max_consecutive_errors=3)

        assert bench.records("out")[1].outcome != "error"

    def test_no_worker_is_left_behind(self, bench: Bench) -> None:
        bench.write_policy(faults={"2": "hang"})
        bench.run("out", workers=2, timeouts={"inference_seconds": 5.0})

        assert bench.worker_pids()
        assert not [pid for pid in bench.worker_pids() if is_alive(pid)]


class TestMistakes:
    """What every episode would repeat ends the run at once, with the error itself and no records."""

    def check(self, bench: Bench, error: type[Exception], match: str, **fields: Any) -> None:
        with pytest.raises(error, match=match):
            bench.run("out", **fields)
        assert not (bench.folder / "out").exists() or not bench.records("out")

    def test_a_camera_that_is_not_there(self, bench: Bench) -> None:
        bench.write_policy(cameras=["wrist"])
        self.check(bench, SpecMismatchError, "camera 'wrist'")

    def test_arguments_that_the_adapter_does_not_take(self, bench: Bench) -> None:
        bench.write_policy(fautls={})
        self.check(bench, RecipeError, "unexpected keyword argument 'fautls'")

    def test_arguments_that_the_task_does_not_take(self, bench: Bench) -> None:
        self.check(bench, Exception, "no argument 'cue_step'. Did you mean 'cue_steps'", env={"cue_step": 1})

    def test_the_last_policy_of_the_list_is_tried_before_the_first_one_is_through(self, bench: Bench) -> None:
        bench.write_policy(pause=0.05)
        fields = {"policies": [str(bench.folder / "night.yaml"), "tour", "oracle"], "episodes": 50}
        fields["env"] = {**SHORT, "n_items": 0}
        with pytest.raises(SpecMismatchError, match="'tour'"):
            bench.run("out", **fields)

        assert len(bench.records("out")) == 1


# ------------------------------------------------------------------------------------------ sameness


class TestSameness:
    def test_any_number_of_workers_gives_the_same_lines(self, bench: Bench) -> None:
        fields: dict[str, Any] = {
            "tasks": [TASK, "InterceptMedium-v0"],
            "policies": [str(bench.folder / "night.yaml"), "random"],
            "n_action_steps": [1, 3],
            "runs": 2,
            "env": {"horizon_steps": 12},
        }
        bench.run("one", workers=1, **fields)
        bench.run("two", workers=2, **fields)

        # 2 tasks x 2 policies x 2 K x 2 runs x 6 seeds
        assert len(bench.lines("one")) == 96
        assert bench.lines("one") == bench.lines("two")

    def test_pictures_change_nothing_but_the_device_is_noted(self, bench: Bench) -> None:
        bench.run("blind")
        bench.write_policy(cameras=["base_camera"])
        bench.run("seeing")

        assert bench.lines("blind") == bench.lines("seeing")
        assert read_run(bench.folder / "seeing").description.environment["device"] == {"simulator": "fake"}

    def test_runs_differ_for_a_policy_that_draws_by_run(self, bench: Bench) -> None:
        bench.run("out", runs=2, episodes=1)

        digests = {record.trajectory_sha256 for record in read_run(bench.folder / "out").records}
        assert len(digests) == 2

    def test_the_record_s_policy_is_the_recipe_s_name(self, bench: Bench) -> None:
        bench.run("out", episodes=1)

        assert bench.records("out")[1].policy == "night"

    def test_scripted_controls_do_on_the_fake_what_they_are_for(self, bench: Bench) -> None:
        bench.run("out", policies=["oracle", "random"], episodes=5, env={})

        rates = {
            policy: [r.success_once for r in read_run(bench.folder / "out").records if r.policy == policy]
            for policy in ("oracle", "random")
        }
        assert rates["oracle"] == [True] * 5
        assert rates["random"] == [False] * 5


# ------------------------------------------------------------------------------------------ resume


class TestResume:
    def test_a_finished_run_is_not_run_again(self, bench: Bench) -> None:
        bench.run("out")
        before = bench.worker_pids()

        summary = bench.run("out")

        assert summary.n_open == 0
        assert bench.worker_pids() == before

    def test_a_changed_configuration_is_refused(self, bench: Bench) -> None:
        bench.run("out")

        with pytest.raises(RunChangedError, match="episodes"):
            bench.run("out", episodes=7)

    def test_a_changed_recipe_is_refused(self, bench: Bench) -> None:
        bench.run("out")
        bench.write_policy(pause=0.001)

        with pytest.raises(RunChangedError, match="policies/night"):
            bench.run("out")

    def test_options_may_change(self, bench: Bench) -> None:
        bench.run("out")

        assert bench.run("out", workers=2, timeouts={"step_seconds": 9.0}).n_open == 0

    def test_the_default_folder_is_that_of_the_configuration(self, bench: Bench) -> None:
        first, same = default_run_folder(bench.config()), default_run_folder(bench.config(workers=2))
        other = default_run_folder(bench.config(episodes=7))

        assert first == same != other
        assert first.parent == Path("runs")
        assert first.name.startswith("test-")


# ------------------------------------------------------------------------------------------ kills


class TestKills:
    """Through the command line, as it is killed in real life."""

    EPISODES = 12

    def start(self, bench: Bench, out: str, *, workers: int = 2) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "vla_eval.cli", "eval", "--task", TASK, "--policy", "night.yaml"]
        command += ["--episodes", str(self.EPISODES), "--workers", str(workers), "--out", out]
        command += [
            "--allow-environment-change",
            "--set",
            "simulator=fake",
            *(f"--set=env.{k}={v}" for k, v in SHORT.items()),
        ]
        return subprocess.Popen(
            command,
            cwd=bench.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            # A shell that runs the tests in the background has SIGINT ignored, and children inherit that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )

    def finish(self, bench: Bench, out: str) -> str:
        stdout, stderr = (process := self.start(bench, out)).communicate(timeout=HANGS_AFTER_S)
        assert process.returncode == 0, stderr
        return stdout

    def test_kill_9_at_any_moment_loses_nothing_and_leaves_nothing(self, bench: Bench) -> None:
        bench.write_policy(pause=0.02)  # 12 steps x 0.02 s: a quarter of a second per episode
        self.finish(bench, "clean")
        rng = random.Random(1)
        for _ in range(3):
            process = self.start(bench, "killed")
            time.sleep(rng.uniform(0.7, 1.6))
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            assert wait_until(lambda: not any(is_alive(pid) for pid in bench.worker_pids()))

        table = self.finish(bench, "killed")

        assert bench.lines("killed") == bench.lines("clean")
        assert len(bench.lines("clean")) == self.EPISODES
        assert "night" in table

    @pytest.mark.parametrize(("number", "exit_code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
    def test_a_signal_stops_the_run_and_says_how_to_go_on(
        self, bench: Bench, number: signal.Signals, exit_code: int
    ) -> None:
        bench.write_policy(pause=0.05)
        process = self.start(bench, "out")
        assert wait_until(lambda: bool(bench.worker_pids()))
        process.send_signal(number)
        stdout, stderr = process.communicate(timeout=HANGS_AFTER_S)

        assert process.returncode == exit_code
        assert stdout == ""
        assert "To go on: mikasa-vla eval --task" in stderr
        assert wait_until(lambda: not any(is_alive(pid) for pid in bench.worker_pids()))
        self.finish(bench, "out")

    def test_a_worker_that_is_killed_is_replaced(self, bench: Bench) -> None:
        bench.write_policy(pause=0.02)
        process = self.start(bench, "out", workers=1)
        assert wait_until(lambda: bool(bench.worker_pids()))
        os.kill(next(iter(bench.worker_pids())), signal.SIGKILL)
        _, stderr = process.communicate(timeout=HANGS_AFTER_S)

        errors = [r.error for r in bench.records("out").values() if r.error]
        assert process.returncode == 3, stderr
        assert [error.kind for error in errors] == ["WorkerCrashed"]
        assert "SIGKILL" in errors[0].message
        assert "--workers" in errors[0].message
        assert len(bench.records("out")) == self.EPISODES


class TestCommandLine:
    def test_standard_output_carries_the_table_alone(
        self, bench: Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(bench.folder)

        code = main(["eval", "demo", "--episodes", "2", "--set", "simulator=fake", "--format", "json"])

        out, err = capsys.readouterr()
        assert code == 0
        # 2 tasks x 3 policies
        assert len(json.loads(out)["rows"]) == 6
        assert "12 episodes, 0 of them finished before" in err

    def test_a_second_run_prints_the_same_table_and_runs_nothing(
        self, bench: Bench, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(bench.folder)
        command = [
            "eval",
            "--task",
            TASK,
            "--policy",
            "night.yaml",
            "--episodes",
            "3",
            "--set",
            "simulator=fake",
        ]
        assert main(command) == 0
        first = capsys.readouterr()

        assert main(command) == 0

        second = capsys.readouterr()
        assert second.out == first.out
        assert "all 3 episodes are there" in second.err
        assert len(list((bench.folder / "runs").iterdir())) == 1

    def test_episodes_that_ended_in_an_error_have_an_exit_code_of_their_own(
        self, bench: Bench, capsys: pytest.CaptureFixture[str]
    ) -> None:
        bench.write_policy(faults={"2": "raise"})
        command = ["eval", "--task", TASK, "--policy", str(bench.folder / "night.yaml"), "--episodes", "3"]
        command += ["--out", str(bench.folder / "out"), "--set", "simulator=fake"]

        code = main(command)

        err = capsys.readouterr().err
        assert code == 3
        assert f"error: night on {TASK}, seed 2, run 0: ZeroDivisionError: a mistake in the policy" in err
        assert "1 episodes ended in an error" in err
