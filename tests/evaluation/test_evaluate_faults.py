"""Whole runs on the fake simulator: faults, timeouts, mistakes, kills; no fault touches another episode."""

import os
import random
import signal
import time
from typing import Any, ClassVar

import pytest

from tests.evaluation import evaluation_bench
from tests.evaluation.evaluation_bench import SHORT, TASK, Bench
from tests.forked import Forked, start_command
from tests.waiting import HANGS_AFTER_S, is_alive, wait_until
from vla_eval.errors import RecipeError, SpecMismatchError, TooManyErrorsError

bench = evaluation_bench.bench

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
    """What every episode would repeat ends the run at once, with the error itself and nothing left behind."""

    def check(self, bench: Bench, error: type[Exception], match: str, **fields: Any) -> None:
        with pytest.raises(error, match=match):
            bench.run("out", **fields)
        assert not (bench.folder / "out").exists()

    def test_more_action_steps_than_a_chunk_has(self, bench: Bench) -> None:
        (bench.folder / "short_policy.py").write_text(
            "import night_policy\n"
            "class Short:\n    min_chunk_size = 2\n"
            "class Context:\n    chunking = Short\n"
            "make = lambda context: night_policy.make(Context)\n"
        )
        bench.write_policy("short_policy:make")
        self.check(bench, Exception, "chunk", n_action_steps=[5])

    def test_a_folder_that_was_there_stays_as_it_was(self, bench: Bench) -> None:
        bench.write_policy(cameras=["wrist"])
        (bench.folder / "out").mkdir()
        with pytest.raises(SpecMismatchError):
            bench.run("out")
        with pytest.raises(SpecMismatchError):
            bench.run("deep/down")

        assert not list((bench.folder / "out").iterdir())
        assert not (bench.folder / "deep").exists()

    def test_a_camera_that_is_not_there(self, bench: Bench) -> None:
        bench.write_policy(cameras=["wrist"])
        self.check(bench, SpecMismatchError, "camera 'wrist'")

    def test_arguments_that_the_adapter_does_not_take(self, bench: Bench) -> None:
        bench.write_policy(fautls={})
        self.check(bench, RecipeError, "unexpected keyword argument 'fautls'")

    def test_arguments_that_the_task_does_not_take(self, bench: Bench) -> None:
        self.check(bench, Exception, "no argument 'cue_step'. Did you mean 'cue_steps'", env={"cue_step": 1})

    def test_the_last_policy_of_the_list_is_tried_before_the_first_one_is_through(self, bench: Bench) -> None:
        bench.write_policy(cameras=["wrist"])
        wrong = (bench.folder / "night.yaml").rename(bench.folder / "wrong.yaml")
        bench.write_policy(pause=0.05)
        policies = [str(bench.folder / "night.yaml"), str(wrong), "oracle"]
        with pytest.raises(SpecMismatchError, match="camera 'wrist'"):
            bench.run("out", policies=policies, episodes=50)

        assert len(bench.records("out")) == 1


# ------------------------------------------------------------------------------------------ kills


class TestKills:
    """Through the command line, as it is killed in real life, but for the seconds of its imports."""

    EPISODES = 12

    def start(self, bench: Bench, out: str, *, workers: int = 2) -> Forked:
        command = ["eval", "--task", TASK, "--policy", "night.yaml"]
        command += ["--episodes", str(self.EPISODES), "--workers", str(workers), "--out", out]
        command += ["--allow-environment-change", "--set", "simulator=fake"]
        return start_command([*command, *(f"--set=env.{k}={v}" for k, v in SHORT.items())], bench.folder)

    def finish(self, bench: Bench, out: str) -> str:
        done = self.start(bench, out).wait(HANGS_AFTER_S)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def test_kill_9_at_any_moment_loses_nothing_and_leaves_nothing(self, bench: Bench) -> None:
        bench.write_policy(pause=0.02)  # 12 steps x 0.02 s: a quarter of a second per episode
        self.finish(bench, "clean")
        rng = random.Random(1)
        for _ in range(3):
            process = self.start(bench, "killed")
            time.sleep(rng.uniform(0.1, 1.6))
            os.killpg(process.pid, signal.SIGKILL)
            process.wait(HANGS_AFTER_S)
            wait_until(lambda: not any(is_alive(pid) for pid in bench.worker_pids()))

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
        wait_until(lambda: bool(bench.worker_pids()))
        os.kill(process.pid, number)
        done = process.wait(HANGS_AFTER_S)

        assert done.returncode == exit_code
        assert done.stdout == ""
        assert "To resume: mikasa-vla eval --task" in done.stderr
        wait_until(lambda: not any(is_alive(pid) for pid in bench.worker_pids()))
        self.finish(bench, "out")

    def test_a_worker_that_is_killed_is_replaced(self, bench: Bench) -> None:
        bench.write_policy(pause=0.02)
        process = self.start(bench, "out", workers=1)
        wait_until(lambda: bool(bench.worker_pids()))
        os.kill(next(iter(bench.worker_pids())), signal.SIGKILL)
        done = process.wait(HANGS_AFTER_S)

        errors = [r.error for r in bench.records("out").values() if r.error]
        assert done.returncode == 3, done.stderr
        assert [error.kind for error in errors] == ["WorkerCrashed"]
        assert "SIGKILL" in errors[0].message
        assert "--workers" in errors[0].message
        assert len(bench.records("out")) == self.EPISODES
