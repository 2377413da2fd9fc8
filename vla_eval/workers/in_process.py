"""The backend without worker processes, for debuggers: jobs are done one after another in this one."""

from collections.abc import Hashable, Iterator, Sequence
from multiprocessing.sharedctypes import RawArray
from pathlib import Path
from typing import Self, cast

from vla_eval.errors import VlaEvalError
from vla_eval.seeding import global_generators_kept
from vla_eval.workers.backend import Service
from vla_eval.workers.inside import SHARED_SIZE, Heartbeat, Runner, SharedStage
from vla_eval.workers.jobs import Answered, Event, Job, JobSource
from vla_eval.workers.load import Load
from vla_eval.workers.messages import Failed, Notice
from vla_eval.workers.process import WorkerMain, WorkerSpec
from vla_eval.workers.start import visible_gpus


class InProcessPool[J: Job, A]:
    """One worker that is this process; see `Pool`."""

    def __init__(self, spec: WorkerSpec) -> None:
        self._spec = spec
        self._shared = cast(SharedStage, RawArray("d", SHARED_SIZE))
        self._runner: Runner | None = None
        self._loaded: Hashable | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._close()

    def run(self, queue: JobSource[J]) -> Iterator[Event[J, A]]:
        """Do all jobs of the queue; see `Pool.run`. Ticks come between jobs."""
        found: list[Notice] = []
        while queue.has_next():
            job = queue.take(self._loaded, taken=())
            assert job is not None  # the queue was not empty
            if self._runner is None or self._loaded != job.setup_key:
                self._close()
                self._runner = self._spec.runner.make(Heartbeat(self._shared), found.append)
                self._loaded = job.setup_key
            self._shared[2] = 0  # what is counted of the job
            with global_generators_kept():
                answer = self._runner.answer(job)
            if isinstance(answer, Failed):
                if answer.error.kind == KeyboardInterrupt.__name__:
                    raise KeyboardInterrupt
                self._close()  # a library may be left in a state that nothing can repair
            yield from found
            found.clear()
            yield Answered(job=job, answer=cast("A | Failed", answer))
            yield None

    def load(self) -> Load:
        """Return that nothing is running: it is asked between jobs."""
        return Load(n_running=0, n_counted=0)

    def _close(self) -> None:
        if self._runner is not None:
            self._runner.close()
        self._runner = self._loaded = None


class InProcessBackend:
    """This process; see `Backend`."""

    @property
    def n_cores(self) -> int:
        """One job at a time."""
        return 1

    @property
    def n_gpus(self) -> int:
        """How many GPUs this process may use."""
        return len(visible_gpus())

    def prepare(self, preload: Sequence[str]) -> None:
        """Do nothing: there is no other process."""

    def pool[J: Job, A](self, spec: WorkerSpec, *, size: int, takes_gpu: bool = False) -> InProcessPool[J, A]:
        """Return the one worker, whatever the size."""
        return InProcessPool(spec)

    def services(self, main: WorkerMain, *, logs: Path, preload: Sequence[str] = ()) -> Sequence[Service]:
        """Refuse: a policy server is another process."""
        raise VlaEvalError(
            "inference: shared needs a server process, and all is done in this one (in_process). Leave out "
            "one of the two."
        )


IN_PROCESS = InProcessBackend()
