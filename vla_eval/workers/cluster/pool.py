"""A pool whose workers are actors of a Ray cluster: every job gets an answer, whatever a machine does.

The driver has the only queue. A worker gets its next jobs when it has answered; Ray retries nothing. If an
actor or its machine dies, what it was doing goes back to the queue, and no result says so. A job that was
lost several times is an error, never a failure.
"""

import contextlib
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Self  # Ray is optional: not looked at by mypy

from vla_eval.errors import ClusterError
from vla_eval.records import EpisodeError
from vla_eval.workers.cluster.actor import Place, WorkerActor
from vla_eval.workers.cluster.connect import on_machine
from vla_eval.workers.cluster.machines import MAX_ERRORS_IN_A_ROW, Machine, Machines
from vla_eval.workers.jobs import Answered, Event, Job, JobSource
from vla_eval.workers.load import Load
from vla_eval.workers.messages import Failed, Notice
from vla_eval.workers.process import CLOSE_SECONDS, END_SECONDS, WorkerSpec

TICK_SECONDS = 0.2
MAX_LOSSES = 3  # of one job: each worker that takes it dies, so it is probably the cause
CALL_SECONDS = 1.0  # short jobs are handed out together until a call takes about so long
MAX_JOBS_PER_CALL = 16


@dataclass(slots=True, kw_only=True, eq=False)
class _Given[J: Job]:
    """A job, and how many workers have died of it or with it."""

    job: J
    n_losses: int = 0


@dataclass(slots=True, kw_only=True, eq=False)
class _Worker[J: Job]:
    """An actor and what it was given; `call` is what it has not answered: its start or its jobs."""

    machine: Machine
    actor: Any
    call: Any
    index: int
    loaded: object = None
    given: list[_Given[J]] = field(default_factory=list)
    is_ready: bool = False
    since: float = 0.0

    @property
    def n_items(self) -> int:
        """How many of what progress counts it has been given."""
        return sum(one.job.n_items for one in self.given)


class ClusterPool[J: Job, A]:
    """Some actors with a worker process, and a GPU (`takes_gpu`), each; a context manager that ends all."""

    def __init__(
        self, ray: Any, machines: Machines, spec: WorkerSpec, place: Place, *, size: int, takes_gpu: bool
    ) -> None:
        self._ray, self._machines, self._spec, self._place = ray, machines, spec, place
        self._size, self._takes_gpu = size, takes_gpu
        self._workers: dict[int, _Worker[J]] = {}
        self._returned: deque[_Given[J]] = deque()
        self._seconds_per_job: float | None = None
        errors = ray.exceptions
        self._losses = (
            *(errors.RayActorError, errors.WorkerCrashedError, errors.NodeDiedError),
            *(errors.OutOfMemoryError, errors.ActorUnschedulableError, errors.ObjectLostError),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        idle = [worker for worker in self._workers.values() if worker.is_ready and not worker.given]
        if kind is None and idle:
            closing = [worker.actor.close.remote() for worker in idle]
            with contextlib.suppress(self._ray.exceptions.RayError):
                self._ray.wait(closing, num_returns=len(closing), timeout=CLOSE_SECONDS + END_SECONDS)
        for index in list(self._workers):
            self._end(index)

    def run(self, queue: JobSource[J]) -> Iterator[Event[J, A]]:
        """Run all jobs of the queue; yields answers as they come, and None on every tick."""
        while True:
            self._machines.look()
            self._hand_out(queue)
            if not any(worker.given for worker in self._workers.values()) and not self._has_next(queue):
                return
            self._start_workers()
            for index, result in self._results():
                yield from self._look_at(index, result)
            self._hand_out(queue)  # before the tick: workers need not wait for the disk
            yield None

    def load(self) -> Load:
        """Return what the workers are doing, machine by machine."""
        return Load(
            n_running=sum(machine.n_running for machine in self._machines), machines=self._machines.loads()
        )

    def _has_next(self, queue: JobSource[J]) -> bool:
        return bool(self._returned) or queue.has_next()

    def _start_workers(self) -> None:
        while len(self._workers) < self._size:
            machine = max(self._machines, key=self._n_free, default=None)
            if machine is None or self._n_free(machine) <= 0:
                break
            index = next(number for number in range(self._size) if number not in self._workers)
            actor = self._ray.remote(WorkerActor).options(
                max_restarts=0,
                max_task_retries=0,
                scheduling_strategy=on_machine(machine.node),
                num_cpus=1,
                num_gpus=1 if self._takes_gpu else 0,
            )
            actor = actor.remote(self._spec, self._place, index, machine.address)
            machine.n_used += 1
            call = actor.ready.remote()
            self._workers[index] = _Worker(machine=machine, actor=actor, call=call, index=index)
        if not self._workers:
            raise ClusterError(
                f"no machine of the cluster is left. What is finished is stored; the same command resumes.\n"
                f"{self._machines.table()}"
            )

    def _n_free(self, machine: Machine) -> int:
        return machine.n_free(takes_gpu=self._takes_gpu)

    def _hand_out(self, queue: JobSource[J]) -> None:
        taken: set[Any] = {worker.loaded for worker in self._workers.values() if worker.loaded is not None}
        for worker in list(self._workers.values()):
            if not worker.is_ready or worker.given:
                continue
            if not worker.machine.is_usable:
                self._end(worker.index)
                continue
            if not self._has_next(queue):
                return
            worker.given = self._next_jobs(queue, worker, taken)
            worker.loaded = worker.given[0].job.setup_key
            worker.since = time.monotonic()
            worker.machine.n_running += worker.n_items
            worker.call = worker.actor.do.remote([one.job for one in worker.given])

    def _next_jobs(self, queue: JobSource[J], worker: _Worker[J], taken: set[Any]) -> list[_Given[J]]:
        """Return one job, or as many short ones of its setup key as fill a call."""
        first = self._next_job(queue, worker.loaded, taken)
        given, n_jobs = [first], 1 if first.n_losses else self._jobs_per_call()
        while len(given) < n_jobs and self._has_next(queue):
            another = self._next_job(queue, first.job.setup_key, taken)
            if another.n_losses or another.job.setup_key != first.job.setup_key:
                self._returned.appendleft(another)
                break
            given.append(another)
        return given

    def _next_job(self, queue: JobSource[J], loaded: Any, taken: set[Any]) -> _Given[J]:
        if self._returned:
            return self._returned.popleft()
        job = queue.take(loaded, taken=taken)
        assert job is not None  # the queue was not empty
        return _Given(job=job)

    def _jobs_per_call(self) -> int:
        if self._seconds_per_job is None:
            return 1
        return max(1, min(MAX_JOBS_PER_CALL, int(CALL_SECONDS / max(self._seconds_per_job, 1e-6))))

    def _results(self) -> list[tuple[int, Any]]:
        """Return which workers have answered what, or died; waits for the first, at most a tick."""
        calls = {worker.call: index for index, worker in self._workers.items() if worker.call is not None}
        if not calls:
            time.sleep(TICK_SECONDS)
            return []
        ready, waiting = self._ray.wait(list(calls), num_returns=1, timeout=TICK_SECONDS)
        if ready and waiting:
            more, _ = self._ray.wait(waiting, num_returns=len(waiting), timeout=0)
            ready = [*ready, *more]
        try:
            results = self._ray.get(ready)  # at once: each call of Ray has its price
        except self._losses:
            results = [self._result(call) for call in ready]
        return [(calls[call], result) for call, result in zip(ready, results, strict=True)]

    def _result(self, call: Any) -> Any:
        try:
            return self._ray.get(call)
        except self._losses as exc:
            return exc

    def _look_at(self, index: int, result: Any) -> Iterator[Event[J, A]]:
        """Take what a worker has answered, or what it leaves behind."""
        worker = self._workers[index]
        worker.call = None
        if isinstance(result, BaseException):
            yield from self._lose(worker, result)
            return
        if not worker.is_ready:
            worker.is_ready = True
            return
        worker.machine.n_running -= worker.n_items
        seconds = (time.monotonic() - worker.since) / len(worker.given)
        before = self._seconds_per_job
        self._seconds_per_job = seconds if before is None else 0.9 * before + 0.1 * seconds
        given, worker.given = deque(worker.given), []
        for event in result:
            if isinstance(event, Notice):
                yield event
                continue
            job = given.popleft().job
            if not isinstance(event, Failed):
                self._machines.note_answer(worker.machine, n_items=job.n_items)
            elif not event.refused:
                what = f"{event.error.kind}: {event.error.message[:200]}"
                self._machines.note_error(worker.machine, what)
            yield Answered(job=job, answer=event, kind=worker.machine.kind)

    def _lose(self, worker: _Worker[J], exc: BaseException) -> Iterator[Event[J, A]]:
        """Put what a dead worker was doing back to the queue; give up what has been lost several times."""
        self._machines.look(at_once=True)
        given = worker.given
        self._end(worker.index)
        cause = str(exc).strip().splitlines()[0] if str(exc).strip() else type(exc).__name__
        if worker.machine.is_alive:
            self._machines.say(f"a worker on {worker.machine.name} died ({cause:.200}); its jobs run again")
            self._machines.note_error(worker.machine, cause)
            n_errors = worker.machine.n_errors_in_a_row
            if not worker.is_ready and n_errors >= MAX_ERRORS_IN_A_ROW and worker.machine.is_usable:
                raise ClusterError(
                    f"{n_errors} workers in a row did not start on {worker.machine.name}, the only machine "
                    f"that is left: {cause} Look into Ray's logs there (session_latest/logs)."
                )
        for one in reversed(given):
            one.n_losses += 1
            if one.n_losses < MAX_LOSSES:
                self._returned.appendleft(one)
                continue
            error = EpisodeError(
                kind="WorkerLost",
                stage="setup",
                message=f"{one.n_losses} workers died while they did this job; the last on "
                f"{worker.machine.name}: {cause} The same command tries it again.",
                details=str(exc),
            )
            yield Answered(job=one.job, answer=Failed(error=error, refused=False))

    def _end(self, index: int) -> None:
        worker = self._workers.pop(index)
        worker.machine.n_used -= 1
        worker.machine.n_running -= worker.n_items
        with contextlib.suppress(self._ray.exceptions.RayError):  # its guard ends what it has started
            self._ray.kill(worker.actor, no_restart=True)
