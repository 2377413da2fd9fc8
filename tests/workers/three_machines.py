"""A cluster of three machines on one machine, and how each of its parts is killed."""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import psutil
import pytest

from vla_eval.evaluation.plan import Plan
from vla_eval.records import EpisodeRecord
from vla_eval.workers.cluster.backend import ClusterBackend
from vla_eval.workers.cluster.connect import LOCAL_VARIABLES
from vla_eval.workers.cluster.machines import Machines
from vla_eval.workers.load import Load

SMALL = {"num_cpus": 1, "object_store_memory": 80 << 20}


class ThreeMachines:
    """Three machines with one core each; the first is Ray's head, which is never killed."""

    def __init__(self, cluster: Any) -> None:
        self.cluster = cluster
        self.nodes = [cluster.add_node(**SMALL, wait=False) for _ in range(2)]
        cluster.wait_for_nodes()
        self.lines: list[str] = []

    def backend(self, **options: Any) -> ClusterBackend:
        import ray

        machines = Machines(ray, say=self.lines.append, **options)
        machines.survey()
        return ClusterBackend(ray, machines)

    def kill_machine(self) -> None:
        """Kill all processes of a machine, as a power cut would."""
        self.cluster.remove_node(self.nodes.pop(), allow_graceful=False)

    def processes_of_machine(self) -> list[int]:
        raylet = self.nodes[-1].all_processes["raylet"][0].process.pid
        below = psutil.Process(raylet).children(recursive=True)
        return [raylet, *(process.pid for process in below)]


def kill_actors(name: str) -> int:
    """Kill every actor of a class; return how many there were."""
    killed = 0
    for pid in pids_of(f"ray::{name}"):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
            killed += 1
    return killed


def pids_of(title: str) -> list[int]:
    """Return the processes whose command line begins so."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if path.read_bytes().startswith(title.encode()):
                found.append(int(path.parent.name))
    return found


class After:
    """An observer that does something once, after some records."""

    def __init__(self, n_records: int, do: Callable[[], object]) -> None:
        self.n_left, self.do = n_records, do

    def on_start(self, plan: Plan, *, n_finished: int, n_workers: int) -> None:
        pass

    def on_device(self, device: Mapping[str, str]) -> None:
        pass

    def on_record(self, record: EpisodeRecord) -> None:
        self.n_left -= 1
        if self.n_left == 0:
            self.do()

    def on_load(self, load: Load) -> None:
        pass

    def on_tick(self) -> bool:
        return False


@pytest.fixture
def three_machines(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[ThreeMachines]:
    """A cluster that this process is connected to; its processes find modules in `tmp_path`."""
    ray: Any = pytest.importorskip("ray", reason="the extra [cluster] is not installed")
    from ray.cluster_utils import Cluster

    for name, value in LOCAL_VARIABLES.items():
        if name != "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER":
            monkeypatch.setenv(name, value)
    # A loaded machine answers late; a machine that is really gone is noticed by its closed connection.
    system = {"health_check_period_ms": 2000, "health_check_timeout_ms": 5000}
    head = {**SMALL, "include_dashboard": False}
    cluster: Any = Cluster(initialize_head=True, head_node_args={**head, "_system_config": system})
    try:
        machines = ThreeMachines(cluster)
        ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
        yield machines
    finally:
        ray.shutdown()
        cluster.shutdown()
