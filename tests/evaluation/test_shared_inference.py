"""Shared inference: records are those of inference in the workers, for any number of workers."""

import contextlib
import json
import os
import signal
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from tests.evaluation.evaluation_bench import Bench
from tests.evaluation.evaluation_bench import bench as bench
from tests.evaluation.resolved import evaluate, make_plan, results_config
from tests.forked import start_command
from tests.waiting import is_alive, wait_until
from vla_eval.errors import RunChangedError, TooManyErrorsError, VlaEvalError
from vla_eval.evaluation import plan as plans
from vla_eval.evaluation import server_phases
from vla_eval.evaluation.plan import Plan
from vla_eval.evaluation.resolve import resolve
from vla_eval.records import EpisodeRecord
from vla_eval.storage.run_folder import read_run
from vla_eval.workers import local
from vla_eval.workers.load import Load

# A recurrent network that infers for all rows of a pass at once: its bits depend on the size of a pass and on
# the row, as those of any network do.
NETWORK_MODULE = """
import os
from pathlib import Path
import numpy as np
from vla_eval.core import ActionChunk
from vla_eval.specs import PolicySpec

HERE = Path(__file__).parent
WIDTH, CHUNK = 96, 3


class Policy:
    def __init__(self, context, checkpoint):
        (HERE / f"pid-{os.getpid()}").touch()
        if (HERE / "broken").exists():
            raise ZeroDivisionError("the weights are broken")
        rng = np.random.default_rng(7)
        self.read, self.keep, self.act_ = (
            rng.standard_normal(shape).astype(np.float32) / 8
            for shape in ((9, WIDTH), (WIDTH, WIDTH), (WIDTH, CHUNK * 7))
        )
        self.n_rows = context.n_slots
        self.spec = PolicySpec(name="net", reads="every", cameras=(), states=("qpos",), chunk_size=CHUNK)
        self.rows, self.memory = {}, {}

    def reset(self, episodes):
        for e in episodes:
            self.rows[e.slot], self.memory[e.slot] = e.row, np.full(WIDTH, e.seed / 10, np.float32)

    def act(self, window):
        return self.act_batch([window])[0]

    def act_batch(self, windows):
        for i in range(max(len(w.frames) for w in windows)):
            due = [w for w in windows if i < len(w.frames)]
            x, memory = np.zeros((self.n_rows, 9), np.float32), np.zeros((self.n_rows, WIDTH), np.float32)
            for w in due:
                row = self.rows[w.slot]
                x[row], memory[row] = w.frames[i].state["qpos"], self.memory[w.slot]
            memory = np.tanh(x @ self.read + memory @ self.keep)
            for w in due:
                self.memory[w.slot] = memory[self.rows[w.slot]].copy()
        memory = np.zeros((self.n_rows, WIDTH), np.float32)
        for w in windows:
            memory[self.rows[w.slot]] = self.memory[w.slot]
        actions = np.tanh(memory @ self.act_).reshape(self.n_rows, CHUNK, 7)
        return [ActionChunk(actions=actions[self.rows[w.slot]].copy()) for w in windows]


def make(context, *, checkpoint):
    return Policy(context, checkpoint)
"""
ROWS = 4


@pytest.fixture
def network(bench: Bench) -> Bench:
    (bench.folder / "net_policy.py").write_text(NETWORK_MODULE)
    bench.write_policy("net_policy:make", checkpoint="none")
    return bench


def run(bench: Bench, out: str, **fields: Any) -> Any:
    summary = bench.run(out, **{"episodes": 10, "n_action_steps": [2], **fields})
    assert (summary.n_open, summary.n_errors) == (0, 0)
    return summary


def shared(bench: Bench, out: str, **fields: Any) -> Any:
    return run(bench, out, **{"inference": "shared", "inference_max_batch": ROWS, **fields})


def test_records_are_those_of_inference_in_the_workers_for_any_number_of_workers(network: Bench) -> None:
    run(network, "in-process", slots_per_worker=ROWS)
    shared(network, "one", workers=1)
    shared(network, "two", workers=2, slots_per_worker=3)
    shared(network, "four", workers=4)

    assert network.lines("in-process") == network.lines("one")
    assert network.lines("one") == network.lines("two") == network.lines("four")
    assert len({record.trajectory_sha256 for record in network.records("one").values()}) == 10


def test_a_model_is_loaded_once_and_policies_without_weights_stay_in_the_workers(network: Bench) -> None:
    policies = [str(network.folder / "night.yaml"), "random", "oracle"]
    shared(network, "shared", workers=2, policies=policies)

    assert len(network.worker_pids()) == 1
    run(network, "in-process", slots_per_worker=ROWS, policies=policies)
    assert network.lines("shared") == network.lines("in-process")


def test_the_choice_is_part_of_what_a_run_is_resumed_with(network: Bench) -> None:
    shared(network, "out")
    with pytest.raises(RunChangedError, match="inference"):
        run(network, "out")
    with pytest.raises(RunChangedError, match="inference_max_batch"):
        shared(network, "out", inference_max_batch=ROWS + 1)
    shared(network, "out", workers=2)


WARMS_UP = """
import threading
from vla_eval.policies.compiled import Compilation


def warm_up(policy, env, sentences):
    policy.thread = threading.get_ident()
    return Compilation(seconds=1.0, n_rows=policy.n_rows, precision="float32", difference=0.002, scale=0.9)


def act_batch(policy, windows):
    assert threading.get_ident() == policy.thread, "CUDA graphs belong to the thread that made them"
    return plain(policy, windows)


plain, Policy.act_batch, Policy.warm_up = Policy.act_batch, act_batch, warm_up
"""


@pytest.mark.parametrize("where", ["in_process", "shared"])
def test_a_network_is_compiled_in_the_thread_that_asks_it_and_tables_say_how_far_it_is_off(
    network: Bench, where: str
) -> None:
    module = network.folder / "net_policy.py"
    module.write_text(NETWORK_MODULE.replace("def make(", f"{WARMS_UP}\n\ndef make("))
    n_rows = ROWS if where == "shared" else 1

    for episodes in (2, 4):  # said once, also where a run is continued
        run(network, "out", inference=where, inference_max_batch=ROWS, workers=1, episodes=episodes)

    notes = [note for session in read_run(network.folder / "out").sessions for note in session.sentences]
    (note,) = notes
    assert f"The network of night was compiled (float32, {n_rows} in a pass)" in note
    assert "of at most 0.9, differ by at most 0.002" in note


def test_only_a_policy_that_takes_it_is_asked_to_compile(
    network: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In an evaluation with `compile`, a policy of another package may be shared, too."""
    asked: list[bool] = []

    class Servers:
        def __init__(self, options: Any, **_: Any) -> None:
            asked.append(options.compile)
            raise InterruptedError

    monkeypatch.setattr("vla_eval.serving.shared.SharedServers", Servers)
    resolved = resolve(network.config(inference="shared"))
    resolved = replace(resolved, config=replace(resolved.config, compile=True))
    plan = plans.make_plan(resolved)
    (phase,) = server_phases.phases(plan)
    with (
        pytest.raises(InterruptedError),
        server_phases.with_servers(phase, resolved, plan, logs=network.folder, stops=lambda: False),
    ):
        pass

    assert asked == [False]


def test_a_policy_that_cannot_be_made_ends_the_run_with_its_cause(network: Bench) -> None:
    (network.folder / "broken").touch()
    with pytest.raises(VlaEvalError, match="the weights are broken"):
        shared(network, "out")


def test_the_servers_of_a_run_end_with_it_even_if_it_is_killed(network: Bench) -> None:
    config = {
        **{"name": "killed", "tasks": ["RememberColor3-v0"], "simulator": "fake", "episodes": 2_000},
        **{"policies": [str(network.folder / "night.yaml")], "inference": "shared", "workers": 1},
    }
    (network.folder / "killed.yaml").write_text(json.dumps(config))
    records = network.folder / "out" / "episodes.jsonl"
    process = start_command(["eval", "killed.yaml", "--out", "out"], network.folder)
    try:
        wait_until(lambda: records.exists() and records.stat().st_size > 0)
        (server,) = network.worker_pids()
    finally:
        os.kill(process.pid, signal.SIGKILL)  # else it evaluates all episodes
    wait_until(lambda: not is_alive(server))


def test_with_several_gpus_each_has_a_server_and_records_are_the_same(
    network: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared(network, "one", workers=2)
    for path in network.folder.glob("pid-*"):
        path.unlink()
    monkeypatch.setattr(local, "visible_gpus", lambda: ("0", "1"))
    shared(network, "two", workers=2)

    assert len(network.worker_pids()) == 2
    assert network.lines("one") == network.lines("two")


@pytest.mark.slow
def test_a_server_that_dies_costs_errors_that_a_resume_heals(network: Bench) -> None:
    class Kills:
        def on_start(self, plan: Plan, *, n_finished: int, n_workers: int) -> None:
            pass

        def on_device(self, device: Mapping[str, str]) -> None:
            pass

        def on_record(self, record: EpisodeRecord) -> None:
            for pid in network.worker_pids():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)

        def on_load(self, load: Load) -> None:
            pass

        def on_tick(self) -> bool:
            return False

    fields: dict[str, Any] = {
        **{"episodes": 10, "n_action_steps": [2], "inference": "shared", "inference_max_batch": ROWS},
        **{"workers": 2, "max_consecutive_errors": 3},
    }
    with pytest.raises(TooManyErrorsError, match="Remote"):
        evaluate(network.config(**fields), out=network.folder / "killed", observer=Kills())
    outcomes = [record.outcome for record in network.records("killed").values()]
    assert outcomes.count("error") >= 3
    shared(network, "killed", workers=2)
    shared(network, "undisturbed", workers=2)
    assert network.lines("killed") == network.lines("undisturbed")


class TestTheChoice:
    def test_it_is_in_the_workers_without_a_gpu(
        self, network: Bench, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(local, "visible_gpus", lambda: ())
        assert resolve(network.config(workers=4)).config.inference == "in_process"

    @pytest.mark.parametrize(
        ("workers", "policy", "expected"),
        [(4, "night.yaml", "shared"), (1, "night.yaml", "in_process"), (4, "random", "in_process")],
    )
    def test_with_a_gpu_it_is_shared_by_several_workers_of_a_policy_with_weights(
        self, network: Bench, monkeypatch: pytest.MonkeyPatch, workers: int, policy: str, expected: str
    ) -> None:
        monkeypatch.setattr(local, "visible_gpus", lambda: ("0",))
        name = str(network.folder / policy) if policy.endswith(".yaml") else policy
        assert resolve(network.config(workers=workers, policies=[name])).config.inference == expected

    def test_in_the_workers_it_is_not_recorded_as_before_there_was_a_choice(self, network: Bench) -> None:
        assert not {"inference", "inference_max_batch"} & set(results_config(network.config()))

    def test_rows_follow_the_seed_whatever_the_slots(self, network: Bench) -> None:
        plan = make_plan(
            network.config(inference="shared", inference_max_batch=2, slots_per_worker=3, episodes=5)
        )
        assert [(job.slot, job.row) for job in plan.jobs] == [(0, 0), (1, 1), (2, 0), (0, 1), (1, 0)]


@pytest.mark.slow
def test_a_network_with_memory_on_maniskill_has_the_same_records(bench: Bench) -> None:
    fields: dict[str, Any] = {
        **{"policies": ["memory_color3"], "simulator": "maniskill", "env": {}},
        **{"n_action_steps": [8], "episodes": 4},
    }
    run(bench, "in-process", slots_per_worker=2, **fields)
    shared(bench, "one", inference_max_batch=2, workers=1, **fields)
    shared(bench, "two", inference_max_batch=2, workers=2, **fields)

    assert bench.lines("in-process") == bench.lines("one") == bench.lines("two")
