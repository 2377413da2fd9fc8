"""The backend of one machine: a pool of processes, and services on the loopback address."""

from collections.abc import Sequence
from pathlib import Path

from vla_eval.workers.jobs import Job
from vla_eval.workers.pool import WorkerPool
from vla_eval.workers.process import WorkerMain, WorkerProcess, WorkerSpec
from vla_eval.workers.start import available_cores, start_server, visible_gpus, worker_context

LOOPBACK = "127.0.0.1"


class LocalService(WorkerProcess):
    """A service on this machine; see `Service`."""

    address = LOOPBACK
    gpu: str | None = None


class LocalBackend:
    """This machine; see `Backend`."""

    @property
    def n_cores(self) -> int:
        """How many cores this process may use."""
        return available_cores()

    @property
    def n_gpus(self) -> int:
        """How many GPUs this process may use."""
        return len(visible_gpus())

    def prepare(self, preload: Sequence[str]) -> None:
        """Start the process that workers are forked from."""
        start_server(preload)

    def pool[J: Job, A](self, spec: WorkerSpec, *, size: int, takes_gpu: bool = False) -> WorkerPool[J, A]:
        """Return worker processes; those that take a GPU each share all of them, so there is one."""
        return WorkerPool(spec, size=1 if takes_gpu else size)

    def services(
        self, main: WorkerMain, *, logs: Path, preload: Sequence[str] = ()
    ) -> tuple[LocalService, ...]:
        """Return one process per GPU, or one."""
        context = worker_context(preload=preload)
        gpus: tuple[str | None, ...] = visible_gpus() or (None,)
        services = []
        for index, gpu in enumerate(gpus):
            service = LocalService(main, context, index=index, log=logs / f"server-{index}.log")
            service.gpu = gpu
            services.append(service)
        return tuple(services)


LOCAL = LocalBackend()
