"""Worker processes with a watchdog: whatever a worker does, an answer comes for every job.

A worker that is busy with one thing for too long is asked where it hangs and then killed; one that
dies is replaced; both give an `EpisodeError` with the cause. Knows nothing of environments, policies
or files of results, nor of what a job is: the inside of a worker is `vla_eval.episode_worker`, or
`vla_eval.data.recording_worker`.
"""

import contextlib
import logging
import os
import signal
import time
from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess, SpawnProcess
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from vla_eval.core import Stage
from vla_eval.episode_worker import (
    MAX_DETAILS,
    STAGES,
    DeviceFound,
    Failed,
    SharedStage,
    write_stage,
)
from vla_eval.recipes import TimeoutConfig
from vla_eval.results.records import EpisodeError
from vla_eval.worker_start import begin, worker_context, worker_environment

TICK_SECONDS = 0.2
FAREWELL_SECONDS = 5.0  # for closing simulators at the end; then they are killed
DUMP_SECONDS = 0.5  # for a hanging worker to write where it hangs
REAP_SECONDS = 5.0  # a process that sits in a driver may survive SIGKILL for a while; go on without it

logger = logging.getLogger(__name__)


class Job(Protocol):
    """What a worker can be told to do; it is sent to it by pickle."""

    @property
    def setup_key(self) -> Hashable:
        """Jobs with the same one need the same preparation, which a worker keeps."""


class JobSource[J: Job](Protocol):
    """Where jobs come from; `JobQueue` is one."""

    def __len__(self) -> int:
        """How many jobs can be handed out now."""

    def take(self, loaded: Hashable | None, *, taken: Collection[Hashable]) -> J | None:
        """Return the next job for a worker that has `loaded` at hand, while others have `taken`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answered[J: Job, A]:
    """What came of one job."""

    job: J
    answer: A | Failed


WorkerMain = Callable[[Connection, SharedStage, Path], None]
"""Entry point of a worker process: pipe, shared memory for its stage, its log."""


@dataclass(slots=True, kw_only=True)
class _Worker[J: Job]:
    """One process and what it was given to do."""

    index: int
    process: ForkServerProcess | SpawnProcess
    connection: Connection
    shared: SharedStage
    log: Path
    job: J | None = None
    loaded: Hashable | None = None
    log_offset: int = 0  # where the log of the present job begins


class WorkerPool[J: Job, A]:
    """Some worker processes; a context manager that leaves none behind.

    Args:
        main: what a process runs: it answers each job `J` by an `A` or a `Failed`.
        size: how many processes at most.
        timeouts: how long a worker may be busy with one thing.
        logs: folder for what the workers write to standard output and error.
        preload: modules that the workers need and that take long to import; see `worker_context`.
    """

    def __init__(
        self,
        main: WorkerMain,
        *,
        size: int,
        timeouts: TimeoutConfig,
        logs: Path,
        preload: Sequence[str] = (),
    ) -> None:
        """Start nothing yet: processes start when there is work for them."""
        self._main = main
        self._size = size
        self._limits: dict[Stage, float] = {
            "setup": timeouts.setup_seconds,
            "reset": timeouts.reset_seconds,
            "step": timeouts.step_seconds,
            "inference": timeouts.inference_seconds,
        }
        self._logs = logs
        self._context = worker_context(preload=preload)
        self._workers: dict[int, _Worker[J]] = {}

    def __enter__(self) -> Self:
        """Return the pool."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """End all processes: gently after success, at once after an exception."""
        idle = [worker for worker in self._workers.values() if worker.job is None and kind is None]
        for worker in idle:
            worker.connection.close()
        deadline = time.monotonic() + FAREWELL_SECONDS
        for worker in idle:
            worker.process.join(max(0.0, deadline - time.monotonic()))
        for worker in list(self._workers.values()):
            self._end(worker)

    def run(self, queue: JobSource[J]) -> Iterator[Answered[J, A] | DeviceFound | None]:
        """Run all jobs of the queue; yields answers as they come, and None on every tick."""
        while True:
            self._hand_out(queue)
            busy = [worker for worker in self._workers.values() if worker.job is not None]
            if not busy:
                return
            wait([worker.connection for worker in busy], timeout=TICK_SECONDS)
            for worker in busy:
                yield from self._look_at(worker)
            yield None

    def _hand_out(self, queue: JobSource[J]) -> None:
        for index in range(self._size):
            worker = self._workers.get(index)
            if (worker is not None and worker.job is not None) or not len(queue):
                continue
            if worker is not None and not worker.process.is_alive():
                self._end(worker)
                worker = None
            taken = {w.loaded for w in self._workers.values() if w.loaded is not None and w is not worker}
            job = queue.take(worker.loaded if worker else None, taken=taken)
            assert job is not None  # the queue was not empty
            worker = worker or self._start(index)
            worker.job, worker.loaded = job, job.setup_key
            worker.log_offset = worker.log.stat().st_size if worker.log.exists() else 0
            write_stage(worker.shared, "setup", time.monotonic())
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # it died: `_look_at` says so
                worker.connection.send(job)

    def _start(self, index: int) -> _Worker[J]:
        ours, theirs = self._context.Pipe()
        shared: SharedStage = self._context.RawArray("d", 2)
        log = self._logs / f"worker-{index}.log"
        with worker_environment() as environment:
            process = self._context.Process(
                target=begin,
                args=(environment, self._main, theirs, shared, log),
                name=f"mikasa-vla worker {index}",
            )
            process.start()
        theirs.close()  # else its end would not be seen as an end of file
        worker = _Worker[J](index=index, process=process, connection=ours, shared=shared, log=log)
        self._workers[index] = worker
        return worker

    def _look_at(self, worker: _Worker[J]) -> Iterator[Answered[J, A] | DeviceFound]:
        """Take what a busy worker has said; then see whether it is alive, and in time."""
        job = worker.job
        assert job is not None  # only busy ones are looked at
        is_alive = worker.process.is_alive()  # before reading: what a dead one has said is then all there
        try:
            while worker.job is not None and worker.connection.poll():
                message: A | Failed | DeviceFound = worker.connection.recv()
                if isinstance(message, DeviceFound):
                    yield message
                    continue
                worker.job = None
                if isinstance(message, Failed):
                    self._end(worker)
                yield Answered(job=job, answer=message)
        except (EOFError, OSError):
            is_alive = False
        if worker.job is None:
            return
        error = self._overtime(worker) if is_alive else self._crash(worker)
        if error is not None:
            worker.job = None
            yield Answered(job=job, answer=Failed(error=error, refused=False))

    def _crash(self, worker: _Worker[J]) -> EpisodeError:
        stage = _stage(worker.shared).stage
        worker.process.join(REAP_SECONDS)  # the pipe may close a moment before the process is gone
        cause = _cause_of_death(worker.process.exitcode)
        self._end(worker)
        return EpisodeError(
            kind="WorkerCrashed",
            stage=stage,
            message=f"The worker process {cause} during {stage}. Its last words are in details, all of "
            f"them in logs/{worker.log.name}.",
            details=_tail(worker),
        )

    def _overtime(self, worker: _Worker[J]) -> EpisodeError | None:
        """Return the error if the worker has been busy with one thing for too long, and kill it."""
        busy = _stage(worker.shared)
        limit_seconds = self._limits[busy.stage]
        if time.monotonic() - busy.since <= limit_seconds:
            return None
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker.process.pid or 0, signal.SIGUSR1)  # it writes the stack of every thread to its log
        time.sleep(DUMP_SECONDS)
        self._end(worker)
        return EpisodeError(
            kind=f"{busy.stage.capitalize()}Timeout",
            stage=busy.stage,
            message=f"The worker was busy with {busy.stage} for more than {limit_seconds:g} s and was "
            f"stopped. Where it hung is in details. If this machine needs so long, raise the limit: "
            f"--set timeouts.{busy.stage}_seconds={2 * limit_seconds:g}",
            details=_tail(worker),
        )

    def _end(self, worker: _Worker[J]) -> None:
        """Kill the process and whatever it has started."""
        if worker.process.pid is not None:
            # It leads a session of its own as soon as it has started; until then killpg finds nothing.
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(worker.process.pid, signal.SIGKILL)
        worker.process.kill()
        worker.process.join(REAP_SECONDS)
        worker.connection.close()
        if worker.process.exitcode is None:
            logger.warning(
                "Worker %d (process %s) does not end; going on without it.", worker.index, worker.process.pid
            )
        self._workers.pop(worker.index, None)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Busy:
    stage: Stage
    since: float  # time.monotonic(), one clock for all processes of the machine


def _stage(shared: SharedStage) -> _Busy:
    """Read what a worker is busy with: the stage first, as `write_stage` writes it last."""
    stage = STAGES[int(shared[1])]
    return _Busy(stage=stage, since=shared[0])


def _tail[J: Job](worker: _Worker[J]) -> str | None:
    """Return the end of what the worker has written since it was given its job."""
    try:
        with worker.log.open("rb") as log:
            log.seek(max(worker.log_offset, worker.log.stat().st_size - MAX_DETAILS))
            return log.read(MAX_DETAILS).decode(errors="replace") or None
    except FileNotFoundError:  # it died before it opened its log
        return None


def _cause_of_death(exitcode: int | None) -> str:
    if exitcode is None:
        return "closed its pipe without ending"
    if exitcode >= 0:
        return f"exited with code {exitcode}"
    name = signal.Signals(-exitcode).name if -exitcode in set(signal.Signals) else f"signal {-exitcode}"
    hint = " (often the kernel, for want of memory: use fewer --workers)" if name == "SIGKILL" else ""
    return f"was killed by {name}{hint}"
