"""Where jobs run: what the process pool of this machine and a cluster have in common.

Evaluations, audits, probes, recordings and replays take a `Backend` and do not know which. Code that plans
the jobs is the only one that writes results.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol, Self

from vla_eval.workers.jobs import Event, Job, JobSource
from vla_eval.workers.load import Load
from vla_eval.workers.process import WorkerMain, WorkerSpec


class Pool[J: Job, A](Protocol):
    """Workers that answer jobs; a context manager that leaves none behind."""

    def __enter__(self) -> Self:
        """Start nothing yet: workers start when there is work for them."""

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End all workers: gently after success, at once after an exception."""

    def run(self, queue: JobSource[J]) -> Iterator[Event[J, A]]:
        """Run all jobs of the queue; yields answers as they come, and None on every tick.

        Every job gets an answer, whatever a worker does.
        """

    def load(self) -> Load:
        """Return what the workers are doing; called while `run` waits for its next event."""


class Service(Protocol):
    """A process that is given one job and runs until it is ended: a policy server.

    Attributes:
        address: IP address that the other workers reach it at.
        gpu: which GPU it is to take, as `CUDA_VISIBLE_DEVICES` names it; None: what it sees.
        log: where its standard output and error go, for messages.
        start_error: why it could not be started or handed its job.
    """

    address: str
    gpu: str | None
    log: Path
    start_error: BaseException | None

    def give(self, job: object) -> None:
        """Start it with its job; returns at once."""

    def read(self) -> list[object]:
        """Return the messages that have come since the last call.

        Raises:
            EOFError: it has ended, and all that it sent has been returned.
            OSError: the connection is broken.
            BrokenMessageError: what has come is not a message.
        """

    def wait(self, seconds: float) -> int | None:
        """Wait for its end; return its exit code if there is one."""

    def ask_to_close(self) -> None:
        """Have it end by itself."""

    def ask_to_end(self) -> None:
        """Have it killed with whatever it has started."""

    def end(self) -> None:
        """Kill it and whatever it has started, and wait until that is done."""

    def tail(self) -> str | None:
        """Return the end of what it has written."""


class Backend(Protocol):
    """The processor cores and GPUs that there are, and how to use them."""

    @property
    def n_cores(self) -> int:
        """How many workers can run at the same time."""

    @property
    def n_gpus(self) -> int:
        """How many GPUs there are."""

    def prepare(self, preload: Sequence[str]) -> None:
        """Begin the slow imports of workers to come, before their jobs are known; returns at once."""

    def pool[J: Job, A](self, spec: WorkerSpec, *, size: int, takes_gpu: bool = False) -> Pool[J, A]:
        """Return at most `size` workers; each takes a whole GPU, where there are some and it `takes_gpu`."""

    def services(self, main: WorkerMain, *, logs: Path, preload: Sequence[str] = ()) -> Sequence[Service]:
        """Return services that are not started yet: one per GPU; one, where there is no GPU.

        Those of this machine write into the folder `logs`; see `worker_context` for `preload`.
        """
