"""A Ray cluster as a backend: workers and servers are actors on its machines."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # Ray is optional: not looked at by mypy

from vla_eval.lock.switch import WRITING_VARIABLE, folders_for_workers
from vla_eval.workers.cluster.actor import OWN_VARIABLES, Place
from vla_eval.workers.cluster.connect import connected
from vla_eval.workers.cluster.machines import Machines
from vla_eval.workers.cluster.pool import ClusterPool
from vla_eval.workers.cluster.service import ClusterService
from vla_eval.workers.jobs import Job
from vla_eval.workers.local import LOOPBACK
from vla_eval.workers.needed_files import Needed
from vla_eval.workers.process import WorkerMain, WorkerSpec


@dataclass(frozen=True, slots=True)
class ClusterBackend:
    """The machines of a cluster, and the connected module `ray`; see `Backend`."""

    ray: Any
    machines: Machines

    @property
    def n_cores(self) -> int:
        """How many cores the cluster may use."""
        return sum(machine.n_cores for machine in self.machines.usable)

    @property
    def n_gpus(self) -> int:
        """How many GPUs the cluster may use."""
        return sum(machine.n_gpus for machine in self.machines.usable)

    def prepare(self, preload: Sequence[str]) -> None:
        """Do nothing: each machine starts its workers by itself."""

    def pool[J: Job, A](self, spec: WorkerSpec, *, size: int, takes_gpu: bool = False) -> ClusterPool[J, A]:
        """Return workers, one core each, and one GPU each where they take one and there is one."""
        takes_gpu = takes_gpu and self.n_gpus > 0
        return ClusterPool(self.ray, self.machines, spec, _place(spec.logs), size=size, takes_gpu=takes_gpu)

    def services(
        self, main: WorkerMain, *, logs: Path, preload: Sequence[str] = ()
    ) -> tuple[ClusterService, ...]:
        """Return one service per GPU; without GPUs, one per machine that has workers."""
        machines = self.machines.usable
        has_gpus = self.n_gpus > 0
        places = [
            machine
            for machine in machines
            for _ in range(machine.n_gpus if has_gpus else min(machine.n_cores, 1))
        ]
        is_one_host = len({machine.address for machine in machines}) == 1
        return tuple(
            ClusterService(
                self.ray,
                machine,
                main,
                preload=tuple(preload),
                place=_place(logs),
                index=index,
                has_gpu=has_gpus,
                address=LOOPBACK if is_one_host else machine.address,
            )
            for index, machine in enumerate(places)
        )


@contextlib.contextmanager
def cluster(
    address: str,
    *,
    say: Callable[[str], None],
    allow_other_kind: bool = False,
    needs: tuple[Needed, ...] = (),
) -> Iterator[ClusterBackend]:
    """Connect, look at every machine, and give what can be used of the cluster.

    `address` is what `check_address` returns; `say` gets lines for a person. `allow_other_kind` uses machines
    with another CPU model or driver, too; each machine must have the files and folders that it `needs`.

    Raises:
        MissingDependencyError: Ray is not installed.
        ClusterError: there is no cluster, or none of its machines can be used.
    """
    with connected(address) as ray:
        machines = Machines(ray, allow_other_kind=allow_other_kind, needs=needs, say=say)
        machines.survey()
        say(machines.table())
        yield ClusterBackend(ray, machines)


def _place(logs: Path) -> Place:
    own = {name: value for name, value in os.environ.items() if name.startswith(OWN_VARIABLES)}
    own[WRITING_VARIABLE] = folders_for_workers()
    return Place(folder=os.getcwd(), variables=own, path=tuple(sys.path), logs=str(logs.resolve()))
