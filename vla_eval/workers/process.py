"""One worker process, from the side of its parent: give it jobs, read its answers, end it."""

import contextlib
import functools
import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, ForkServerProcess, SpawnContext, SpawnProcess
from pathlib import Path

from vla_eval.config.evaluation import TimeoutConfig
from vla_eval.core import Stage
from vla_eval.workers.framing import BrokenMessageError, Inbox
from vla_eval.workers.guard import ASK_WHERE, END, REAP_SECONDS
from vla_eval.workers.inside import SHARED_SIZE, STAGES, RunnerClass, SharedStage, worker_main, write_stage
from vla_eval.workers.messages import MAX_DETAILS
from vla_eval.workers.start import (
    PROCESS_NAME,
    begin,
    end_server,
    start_by_lasting_thread,
    worker_environment,
)

CLOSE_SECONDS = 5.0  # for closing a simulator; then it is killed
END_SECONDS = REAP_SECONDS + 1  # the guard gives up earlier
START_ATTEMPTS = 2  # the process that workers are forked from may have been killed: then there is a new one

WorkerMain = Callable[[Connection, SharedStage, Path], None]
"""Entry point of a worker process: pipe, shared memory for its stage, its log."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerSpec:
    """What the workers of a pool are made of, wherever they run."""

    runner: RunnerClass  # what answers each job `J` by an `A` or a `Failed`
    answers: tuple[type, ...]  # the classes of `A`; anything else that a worker sends is an error
    timeouts: TimeoutConfig  # how long a worker may be busy with one thing
    logs: Path  # folder for what workers of this machine write to standard output and error
    # modules that they need and that take long to import; see `worker_context`
    preload: tuple[str, ...] = ()

    @property
    def main(self) -> WorkerMain:
        """What a process runs."""
        return functools.partial(worker_main, self.runner)


logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Busy:
    """The stage of a worker, and since when by `time.monotonic`: one clock for the whole machine."""

    stage: Stage
    since: float


class WorkerProcess:
    """One process; it starts with its first job.

    `predecessor` is to end before it starts: two policies are never loaded at once.
    """

    def __init__(
        self,
        main: WorkerMain,
        context: ForkServerContext | SpawnContext,
        *,
        index: int,
        log: Path,
        predecessor: "WorkerProcess | None" = None,
    ) -> None:
        self.index = index
        self.log = log
        self.connection, self._their_connection = context.Pipe()
        self.start_error: BaseException | None = None  # why it could not be started or handed a job
        self._inbox = Inbox(self.connection)
        self._their_lifeline, self._lifeline = context.Pipe(duplex=False)
        self._shared: SharedStage = context.RawArray("d", SHARED_SIZE)
        self._main = main
        self._context = context
        self._predecessor = predecessor
        self._process: ForkServerProcess | SpawnProcess | None = None
        self.is_starting = False  # whether the system was asked for the process and has not answered yet
        self._is_abandoned = False
        self._thread: threading.Thread | None = None
        self._log_offset = 0  # where the log of the present job begins
        self._given_at = 0.0

    def give(self, job: object) -> None:
        """Have the process do a job, starting it if need be; returns at once."""
        self._log_offset = self.log.stat().st_size if self.log.exists() else 0
        self._given_at = time.monotonic()
        self._shared[2] = 0
        write_stage(self._shared, "setup", self._given_at)
        self._thread = threading.Thread(target=self._hand_over, args=(job,), daemon=True)
        self._thread.start()

    def read(self) -> list[object]:
        """Return what it has sent; see `Inbox.read`."""
        return self._inbox.read()

    def busy(self) -> Busy:
        """Return what it is busy with; a `BrokenMessageError` after a stray write into its memory."""
        # The stage first, as `write_stage` writes it last.
        stage, since = self._shared[1], self._shared[0]
        if stage not in range(len(STAGES)) or not self._given_at <= since <= time.monotonic():
            raise BrokenMessageError(
                f"expected a stage and its time in shared memory, found {stage}, {since}"
            )
        return Busy(stage=STAGES[int(stage)], since=since)

    @property
    def count(self) -> float:
        """What it has counted of its job."""
        return float(self._shared[2])

    def ask_where(self) -> None:
        """Have it write the stack of every thread to its log."""
        self._send(ASK_WHERE)

    def wait(self, seconds: float) -> int | None:
        """Wait for its end; return its exit code if there is one."""
        deadline = time.monotonic() + seconds
        if self._thread is not None:
            self._thread.join(seconds)
        if self._process is None:
            return None
        self._process.join(max(0.0, deadline - time.monotonic()))
        return self._process.exitcode

    def ask_to_close(self) -> None:
        """Have an idle worker close its simulator and end."""
        with contextlib.suppress(OSError):  # it has ended
            self.connection.send(None)

    def ask_to_end(self) -> None:
        """Have the guard kill the process and whatever it has started."""
        self._is_abandoned = True
        self._send(END)

    def end(self) -> None:
        """Kill the process and whatever it has started, and wait until that is done."""
        self.ask_to_end()
        exitcode = self.wait(END_SECONDS)
        if self.is_starting:
            end_server()
            exitcode = self.wait(END_SECONDS)
        if self._process is not None and exitcode is None:
            self._process.kill()
            if self.wait(1.0) is None:
                logger.warning(
                    "Worker %d (process %s) does not end; continuing without it.",
                    self.index,
                    self._process.pid,
                )
        self.connection.close()
        self._lifeline.close()

    def tail(self) -> str | None:
        """Return the end of what it has written since it was given its job."""
        try:
            with self.log.open("rb") as log:
                log.seek(max(self._log_offset, self.log.stat().st_size - MAX_DETAILS))
                return log.read(MAX_DETAILS).decode(errors="replace") or None
        except FileNotFoundError:  # it ended before it opened its log
            return None

    def _send(self, request: bytes) -> None:
        with contextlib.suppress(OSError):  # it has ended
            os.write(self._lifeline.fileno(), request)

    def _hand_over(self, job: object) -> None:
        try:
            if self._process is None:
                self._start()
            self.connection.send(job)
        except (BrokenPipeError, ConnectionResetError) as exc:
            # It has ended: the parent reads that from the pipe.
            logger.debug("worker %d: %s", self.index, exc)
        except BaseException as exc:  # the parent reports it
            self.start_error = exc

    def _start(self) -> None:
        if self._predecessor is not None:
            self._predecessor.ask_to_close()
            self._predecessor.wait(CLOSE_SECONDS)
            self._predecessor.end()
            self._predecessor = None
        try:
            for attempt in range(START_ATTEMPTS):
                try:
                    start_by_lasting_thread(self._start_once)
                    break
                except (EOFError, ConnectionError):
                    if self._is_abandoned or attempt + 1 == START_ATTEMPTS:
                        raise
                    end_server()  # it is dying; another one is started once it is gone
        finally:
            self._their_connection.close()  # else its end would not be seen as an end of file
            self._their_lifeline.close()

    def _start_once(self) -> None:
        with worker_environment() as environment:
            if self._is_abandoned:
                return
            own = (self._their_lifeline, self._main, self._their_connection, self._shared, self.log)
            process = self._context.Process(
                target=begin, args=(environment, *own), name=f"{PROCESS_NAME} worker {self.index}"
            )
            self.is_starting = True
            try:
                process.start()
            finally:
                self.is_starting = False
            self._process = process
