"""Records of a cluster are those of the process pool, bit for bit, whatever dies on the way."""

import json
import os
import signal
import subprocess
import sys
from typing import Any

import pytest

from tests.evaluation.evaluation_bench import Bench
from tests.evaluation.evaluation_bench import bench as bench
from tests.evaluation.resolved import evaluate
from tests.evaluation.test_shared_inference import NETWORK_MODULE
from tests.waiting import wait_until
from tests.workers.three_machines import After, ThreeMachines, kill_actors, pids_of
from tests.workers.three_machines import three_machines as three_machines
from vla_eval.evaluation.evaluate import EvaluationSummary
from vla_eval.workers.cluster.backend import ClusterBackend

N_EPISODES = 45
LONG: dict[str, Any] = {"episodes": N_EPISODES, "workers": "auto"}  # a third of them on each machine


def on_cluster(bench: Bench, out: str, backend: ClusterBackend, observer: Any = None, **fields: Any) -> Any:
    config = bench.config(**{**LONG, **fields})
    return evaluate(config, out=bench.folder / out, backend=backend, observer=observer)


def expect_whole(bench: Bench, summary: EvaluationSummary, **fields: Any) -> None:
    """Every episode has one result, and it is that of the process pool."""
    assert (summary.n_open, summary.n_errors) == (0, 0)
    bench.run("local", **{**LONG, "workers": 2, **fields})
    assert bench.lines(summary.out.name) == bench.lines("local")
    assert len(bench.lines("local")) == N_EPISODES


@pytest.mark.slow
def test_records_are_those_of_the_process_pool(bench: Bench, three_machines: ThreeMachines) -> None:
    backend = three_machines.backend()
    assert backend.n_cores == 3

    summary = on_cluster(bench, "cluster", backend)

    expect_whole(bench, summary)
    assert sum(machine.n_done for machine in backend.machines) == N_EPISODES


@pytest.mark.slow
class TestFaults:
    """What was running is run again; what is finished is neither lost nor counted twice."""

    @pytest.fixture(autouse=True)
    def _slow_policy(self, bench: Bench) -> None:
        bench.write_policy(pause=0.05)  # half a second an episode: the fault comes half-way

    def test_a_machine_dies(self, bench: Bench, three_machines: ThreeMachines) -> None:
        observer = After(15, three_machines.kill_machine)
        summary = on_cluster(bench, "cluster", three_machines.backend(), observer)
        expect_whole(bench, summary)
        # Before Ray has noticed that the machine is gone, it says that its worker died.
        assert any("is gone" in line or "died" in line for line in three_machines.lines)

    def test_all_actors_are_killed(self, bench: Bench, three_machines: ThreeMachines) -> None:
        killed: list[int] = []
        observer = After(15, lambda: killed.append(kill_actors("WorkerActor")))
        summary = on_cluster(bench, "cluster", three_machines.backend(), observer)
        expect_whole(bench, summary)
        assert killed and killed[0] >= 2

    def test_a_policy_server_is_killed(self, bench: Bench, three_machines: ThreeMachines) -> None:
        (bench.folder / "net_policy.py").write_text(NETWORK_MODULE)
        bench.write_policy("net_policy:make", checkpoint="none")
        shared = {"inference": "shared", "inference_max_batch": 4, "n_action_steps": [2]}
        killed: list[int] = []
        observer = After(15, lambda: killed.append(kill_actors("ServiceActor")))
        summary = on_cluster(bench, "cluster", three_machines.backend(), observer, **shared)
        expect_whole(bench, summary, **shared)
        assert killed == [3]  # one server per machine, since there is no GPU

    def test_the_network_of_a_machine_is_cut_for_30_seconds(
        self, bench: Bench, three_machines: ThreeMachines
    ) -> None:
        stopped = three_machines.processes_of_machine()

        def cut() -> None:
            stopped[:] = three_machines.processes_of_machine()
            for pid in stopped:
                os.kill(pid, signal.SIGSTOP)
            resume = f"sleep 30; kill -CONT {' '.join(map(str, stopped))} 2>/dev/null"
            subprocess.Popen(("sh", "-c", resume), start_new_session=True)

        summary = on_cluster(bench, "cluster", three_machines.backend(), After(15, cut))
        expect_whole(bench, summary)

    def test_the_driver_is_killed_and_started_again(
        self, bench: Bench, three_machines: ThreeMachines
    ) -> None:
        config = {
            **{"name": "killed", "tasks": ["RememberColor3-v0"], "simulator": "fake"},
            **{"policies": [str(bench.folder / "night.yaml")], "episodes": N_EPISODES},
            "env": {"horizon_steps": 12, "cue_steps": 1, "delay_steps": 1},
        }
        (bench.folder / "killed.yaml").write_text(json.dumps(config))
        out = bench.folder / "cluster"
        command = (sys.executable, "-m", "vla_eval.cli", "eval", str(bench.folder / "killed.yaml"))
        command += ("--cluster", str(three_machines.cluster.address), "--out", str(out))
        path = f"{bench.folder}:{os.environ.get('PYTHONPATH', '')}"
        with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}) as process:
            try:
                wait_until(
                    lambda: len(bench.lines("cluster")) >= 15 if (out / "episodes.jsonl").exists() else False
                )
            finally:
                process.kill()
        wait_until(lambda: not pids_of("ray::WorkerActor"))  # they end with their driver
        n_before = len(bench.lines("cluster"))

        done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, check=False)

        assert done.returncode == 0 and n_before < N_EPISODES
        bench.run("local", **{**LONG, "workers": 2})
        assert bench.lines("cluster") == bench.lines("local")
