"""One thread that asks the policy: never waits when idle, and batches what arrived during the last pass.

A pass has at most one request per row and at most as many requests as the policy has rows. A row's answer
does not depend on who else is in the pass; that is the policy's promise (`BatchPolicy`). Knows nothing of
sockets or sessions.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from vla_eval.core import (
    ActionChunk,
    EpisodeStart,
    ForgettingPolicy,
    MemoryArrays,
    ObservationWindow,
    Policy,
    RememberingPolicy,
    infer,
)
from vla_eval.episode_log import chunk_problem
from vla_eval.errors import InvalidActionError, SpecMismatchError, VlaEvalError
from vla_eval.seeding import seed_global_generators
from vla_eval.serving.metrics import ServerMetrics
from vla_eval.workers.messages import describe_error

logger = logging.getLogger(__name__)


class Inference(NamedTuple):
    """A chunk, and how long it took: seconds in the queue, and of the pass."""

    chunk: ActionChunk
    queue_seconds: float
    infer_seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Begin:
    slot: int
    start: EpisodeStart | None  # None: only forget what was before
    done: Future[None] = field(default_factory=Future)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Infer:
    slot: int
    start: EpisodeStart
    window: ObservationWindow
    asked_at: float
    done: Future[Inference] = field(default_factory=Future)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Memory:
    slot: int
    memory: MemoryArrays | None  # what is put in place of the slot's; None: it is read
    done: Future[MemoryArrays | None] = field(default_factory=Future)


class PolicyFailure(VlaEvalError):
    """The policy raised an exception; it is the cause."""


_Request = _Begin | _Infer | _Memory


class Batcher:
    """Asks a policy on behalf of many, with `n_rows` in a pass; nobody else may call it any more.

    `prepare` is called first, in the thread that asks; `prepared` has what it returns or raises.
    """

    def __init__(
        self,
        policy: Policy,
        *,
        n_rows: int,
        action_dims: Sequence[str],
        metrics: ServerMetrics,
        prepare: Callable[[], Any] = lambda: None,  # Any: what `prepared` is to have
    ) -> None:
        self._policy, self._n_rows, self._metrics = policy, n_rows, metrics
        self._action_dims = action_dims
        self._queue: deque[_Request] = deque()
        self._changed = threading.Condition()
        self._is_closed = False
        self._prepare_thread = prepare
        self._unready: dict[int, PolicyFailure] = {}  # slots whose episode could not be begun
        self._thread = threading.Thread(target=self._work, name="inference", daemon=True)
        self.prepared: Future[Any] = Future()
        self._thread.start()

    def begin(self, start: EpisodeStart) -> Future[None]:
        """Begin an episode in its slot, after what was asked for that slot before."""
        return self._put(_Begin(slot=start.slot, start=start)).done

    def infer(self, start: EpisodeStart, window: ObservationWindow) -> Future[Inference]:
        """Infer a chunk for an episode that was begun."""
        request = _Infer(slot=window.slot, start=start, window=window, asked_at=time.monotonic())
        return self._put(request).done

    def memory(self, slot: int, memory: MemoryArrays | None) -> Future[MemoryArrays | None]:
        """Replace what the policy remembers of a slot, or read it if None is given."""
        return self._put(_Memory(slot=slot, memory=memory)).done

    def forget(self, slot: int) -> None:
        """Have the policy forget a slot, after what was asked for it before."""
        self._put(_Begin(slot=slot, start=None))

    def close(self, *, seconds: float | None = None) -> bool:
        """Finish the pass under way, cancel the rest, and end the thread; return whether it has ended."""
        with self._changed:
            self._is_closed = True
            waiting, self._queue = self._queue, deque()
            self._changed.notify()
        for request in waiting:
            request.done.cancel()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _put[R: (_Begin, _Infer, _Memory)](self, request: R) -> R:
        with self._changed:
            if self._is_closed:
                request.done.cancel()
            else:
                self._queue.append(request)
                self._changed.notify()
        return request

    def _work(self) -> None:
        try:
            self.prepared.set_result(self._prepare_thread())
        except BaseException as exc:  # also SystemExit: raised where it is waited for
            self.prepared.set_exception(exc)
            return
        while True:
            with self._changed:
                while not self._queue and not self._is_closed:
                    self._changed.wait()
                if self._is_closed:
                    return
                chosen, self._queue = next_pass(self._queue, n_rows=self._n_rows)
            due: list[_Infer] = []
            for request in chosen:
                if not request.done.set_running_or_notify_cancel():
                    continue  # its client is gone
                if isinstance(request, _Begin):
                    self._prepare(request)
                elif request.slot in self._unready:
                    request.done.set_exception(self._unready[request.slot])
                elif isinstance(request, _Memory):
                    self._remember(request)
                else:
                    due.append(request)
            if due:
                self._infer(due)

    def _prepare(self, request: _Begin) -> None:
        try:
            if request.start is not None:
                self._policy.reset([request.start])
            elif isinstance(self._policy, ForgettingPolicy):
                self._policy.forget([request.slot])
        except BaseException as exc:  # also SystemExit: a policy must not end the thread unseen
            failure = self._failure(exc, "reset")
            self._unready[request.slot] = failure
            request.done.set_exception(failure)
        else:
            self._unready.pop(request.slot, None)
            request.done.set_result(None)

    def _remember(self, request: _Memory) -> None:
        policy, found = self._policy, None
        try:
            if not isinstance(policy, RememberingPolicy) or not policy.spec.has_memory:
                raise SpecMismatchError(f"policy '{policy.spec.name}' has no memory to read or to replace.")
            if request.memory is None:
                found = policy.get_memory(request.slot)
            else:
                policy.set_memory(request.slot, request.memory)
        except SpecMismatchError as exc:
            request.done.set_exception(exc)
        except BaseException as exc:  # as above
            request.done.set_exception(self._failure(exc, "inference"))
        else:
            request.done.set_result(found)

    def _failure(self, exc: BaseException, stage: Literal["reset", "inference"]) -> PolicyFailure:
        error = describe_error(exc, stage)
        logger.error("the policy failed during %s:\n%s", stage, error.details)
        self._metrics.count_error()
        failure = PolicyFailure(f"the policy failed during {stage}: {error.kind}: {error.message}")
        failure.__cause__ = exc
        return failure

    def _infer(self, due: list[_Infer]) -> None:
        """Do a pass; if it fails, one pass for each request, so that the error is that of one session."""
        begun = time.monotonic()
        try:
            chunks = self._ask(due)
        except BaseException as exc:  # as above
            if len(due) > 1:
                logger.warning("a pass of %d failed (%r); asking one by one", len(due), exc)
                for request in due:
                    self._infer([request])
                return
            due[0].done.set_exception(self._failure(exc, "inference"))
            return
        seconds = time.monotonic() - begun
        waits = [begun - request.asked_at for request in due]
        self._metrics.count_pass(n_requests=len(due), infer_seconds=seconds, queue_seconds=sum(waits))
        for request, chunk, wait in zip(due, chunks, waits, strict=True):
            problem = chunk_problem(chunk, chunk_size=self._policy.spec.chunk_size, dims=self._action_dims)
            if problem is None:
                request.done.set_result(Inference(chunk, wait, seconds))
            else:  # not asked again: the policy has seen the frames
                request.done.set_exception(self._failure(InvalidActionError(problem), "inference"))

    def _ask(self, due: list[_Infer]) -> list[ActionChunk]:
        start, step = due[0].start, due[0].window.last.step
        # For policies that draw from generators that all code shares: nothing asked before affects a draw.
        seed_global_generators("served", start.task, start.run, start.seed, step)
        chunks = infer(self._policy, [request.window for request in due])
        if len(chunks) != len(due):
            raise ValueError(f"the policy gave {len(chunks)} chunks for {len(due)} windows")
        return chunks


def next_pass(queue: deque[_Request], *, n_rows: int) -> tuple[list[_Request], deque[_Request]]:
    """Return what is done next, oldest first, and what stays in the queue, for a pass of `n_rows`.

    The oldest request is always taken. One for a row that is taken waits, and so does all that was asked
    later for the same slot.
    """
    chosen: list[_Request] = []
    left: deque[_Request] = deque()
    rows: set[int] = set()
    waiting: set[int] = set()  # slots of which nothing more may be taken
    for request in queue:
        if request.slot in waiting:
            left.append(request)
        elif not isinstance(request, _Infer):
            chosen.append(request)
        elif request.start.row in rows or len(rows) >= n_rows:
            waiting.add(request.slot)
            left.append(request)
        else:
            chosen.append(request)
            rows.add(request.start.row)
            waiting.add(request.slot)
    return chosen, left
