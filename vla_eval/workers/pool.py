"""Worker processes with a watchdog: every job gets an answer, whatever a worker does.

Ours: `multiprocessing.Pool`, `concurrent.futures` and loky do not limit the time of a job, pebble does not
limit it by stage, and none of them ends what a policy has started.

A worker that exceeds a time limit writes its stack to its log and is killed; one that dies is replaced.
Both give an `EpisodeError` with the cause. A process does the jobs of one setup key only: whatever a policy
changes in its process ends with it.
"""

import signal
import time
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Self, cast

from vla_eval.core import Stage
from vla_eval.records import EpisodeError
from vla_eval.workers.framing import BrokenMessageError
from vla_eval.workers.jobs import Answered, Event, Job, JobSource
from vla_eval.workers.load import Load
from vla_eval.workers.messages import Failed, Notice
from vla_eval.workers.process import CLOSE_SECONDS, END_SECONDS, WorkerProcess, WorkerSpec
from vla_eval.workers.start import end_server, server_is_stopped, worker_context

TICK_SECONDS = 0.2
DUMP_SECONDS = 0.5  # for a stuck worker to write its stack


@dataclass(slots=True, kw_only=True)
class _Worker[J: Job]:
    """One process and what it was given to do."""

    process: WorkerProcess
    loaded: Hashable
    job: J | None


class WorkerPool[J: Job, A]:
    """Some worker processes, numbered from `first_index`; a context manager that leaves none behind."""

    def __init__(self, spec: WorkerSpec, *, size: int, first_index: int = 0) -> None:
        self._spec, self._size, self._first_index = spec, size, first_index
        self._answers = (*spec.answers, Failed)
        self._context = worker_context(preload=spec.preload)
        self._workers: dict[int, _Worker[J]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        idle = [worker for worker in self._workers.values() if worker.job is None and kind is None]
        for worker in idle:
            worker.process.ask_to_close()
        deadline = time.monotonic() + CLOSE_SECONDS
        for worker in idle:
            worker.process.wait(max(0.0, deadline - time.monotonic()))
        for worker in self._workers.values():
            worker.process.ask_to_end()
        for worker in self._workers.values():
            worker.process.end()
        self._workers.clear()

    def run(self, queue: JobSource[J]) -> Iterator[Event[J, A]]:
        """Run all jobs of the queue; yields answers as they come, and None on every tick."""
        while True:
            self._hand_out(queue)
            busy = {index: worker for index, worker in self._workers.items() if worker.job is not None}
            if not busy:
                return
            wait([worker.process.connection for worker in busy.values()], timeout=TICK_SECONDS)
            for index, worker in busy.items():
                yield from self._look_at(index, worker)
            yield None

    def load(self) -> Load:
        """Return what the workers are doing."""
        busy = [(worker.process, worker.job) for worker in self._workers.values() if worker.job is not None]
        return Load(
            n_running=sum(job.n_items for _, job in busy),
            n_counted=round(sum(process.count for process, _ in busy)),
        )

    def _hand_out(self, queue: JobSource[J]) -> None:
        for index in range(self._size):
            worker = self._workers.get(index)
            if (worker is not None and worker.job is not None) or not queue.has_next():
                continue
            if worker is not None and worker.process.connection.poll():  # which an idle one does at its end
                self._end(index)
                worker = None
            taken = {other.loaded for other in self._workers.values() if other is not worker}
            job = queue.take(worker.loaded if worker else None, taken=taken)
            assert job is not None  # the queue was not empty
            if worker is None or worker.loaded != job.setup_key:
                number = self._first_index + index
                process = WorkerProcess(
                    self._spec.main,
                    self._context,
                    index=number,
                    log=self._spec.logs / f"worker-{number}.log",
                    predecessor=worker.process if worker else None,
                )
                worker = self._workers[index] = _Worker(process=process, loaded=job.setup_key, job=None)
            worker.job = job
            worker.process.give(job)

    def _look_at(self, index: int, worker: _Worker[J]) -> Iterator[Answered[J, A] | Notice]:
        """Read the messages of a busy worker; then check that it is alive, and within its time limit."""
        job = worker.job
        assert job is not None  # only busy ones are looked at
        error: EpisodeError | None
        try:
            for message in worker.process.read():
                if isinstance(message, Notice):
                    yield message
                    continue
                if worker.job is None or not isinstance(message, self._answers):
                    raise BrokenMessageError(
                        f"expected an answer, found one of type {type(message).__name__}"
                    )
                worker.job = None
                if isinstance(message, Failed):
                    self._end(index)
                yield Answered(job=job, answer=cast("A | Failed", message))
                if isinstance(message, Failed):
                    return
            if worker.job is None:
                return
            error = self._overtime(index, worker.process)
        except BrokenMessageError as exc:
            self._end(index)
            if worker.job is None:  # it has answered; what it sends beyond that belongs to no job
                return
            error = _crashed(worker.process, f"wrote into the parent's pipe or memory: {exc}")
        except (EOFError, OSError):
            exitcode = worker.process.wait(END_SECONDS)  # the pipe closes a moment before the process is gone
            error = _crashed(worker.process, _cause_of_death(exitcode))
            self._end(index)
        if error is not None:
            worker.job = None
            yield Answered(job=job, answer=Failed(error=error, refused=False))

    def _overtime(self, index: int, process: WorkerProcess) -> EpisodeError | None:
        """Return an error if the worker could not be started, or if it is busy for too long; then kill it."""
        if process.start_error is not None:
            self._end(index)
            return _crashed(process, f"could not be started: {process.start_error!r}")
        if process.is_starting and server_is_stopped():
            end_server()  # the worker's start is then tried again, from another server
            return None
        busy = process.busy()
        limit_seconds = float(getattr(self._spec.timeouts, f"{busy.stage}_seconds"))
        if time.monotonic() - busy.since <= limit_seconds:
            return None
        process.ask_where()  # it writes the stack of every thread to its log
        time.sleep(DUMP_SECONDS)
        doing = "starting its process" if process.is_starting else f"busy with {busy.stage}"
        self._end(index)
        return EpisodeError(
            kind=f"{busy.stage.capitalize()}Timeout",
            stage=busy.stage,
            message=f"The worker was {doing} for more than {limit_seconds:g} s and was "
            f"stopped. Where it hung is in details. If this machine needs so long, raise the limit: "
            f"--set timeouts.{busy.stage}_seconds={2 * limit_seconds:g}",
            details=process.tail(),
        )

    def _end(self, index: int) -> None:
        self._workers.pop(index).process.end()


def _crashed(process: WorkerProcess, what: str) -> EpisodeError:
    try:
        stage: Stage = process.busy().stage
    except BrokenMessageError:
        stage = "setup"
    return EpisodeError(
        kind="WorkerCrashed",
        stage=stage,
        message=f"The worker process {what} during {stage}. The end of its output is in details, all of it "
        f"in logs/{process.log.name}.",
        details=process.tail(),
    )


def _cause_of_death(exitcode: int | None) -> str:
    if exitcode is None:
        return "closed its pipe without ending"
    if exitcode >= 0:
        return f"exited with code {exitcode}"
    name = signal.Signals(-exitcode).name if -exitcode in set(signal.Signals) else f"signal {-exitcode}"
    hint = " (often the kernel, out of memory: use fewer --workers)" if name == "SIGKILL" else ""
    return f"was killed by {name}{hint}"
