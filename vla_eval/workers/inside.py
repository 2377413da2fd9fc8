"""The inside of any worker process: its heartbeat, its log, the loop that answers jobs. Knows no jobs."""

import ctypes
import faulthandler
import functools
import importlib
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol, TextIO, cast

from vla_eval.core import Stage
from vla_eval.plain_text import PlainStream
from vla_eval.records import EpisodeKey, EpisodeTiming
from vla_eval.workers.framing import send_message
from vla_eval.workers.messages import Notice

logger = logging.getLogger(__name__)

STAGES: tuple[Stage, ...] = ("setup", "reset", "step", "inference")

SharedStage = ctypes.Array[ctypes.c_double]
"""Memory shared with the parent: time.monotonic() when the stage began, index of the stage, and a count of
the job's progress: an episode's control steps, a policy server's seconds in forward passes."""
SHARED_SIZE = 3


class Heartbeat:
    """Writes the current stage to shared memory, and adds up the time per stage."""

    def __init__(self, shared: SharedStage) -> None:
        self._shared = shared
        self._stage: Stage | None = None
        self._since = 0.0
        self.seconds: dict[Stage, float] = dict.fromkeys(STAGES, 0.0)

    def __call__(self, stage: Stage) -> None:
        """Begin a stage."""
        now = time.monotonic()
        self._add_up(now)
        self._stage, self._since = stage, now
        write_stage(self._shared, stage, now)

    def count(self) -> None:
        """Count one more of what the job consists of."""
        add_count(self._shared, 1)

    @property
    def n_counted(self) -> int:
        """How many were counted of this job."""
        return round(self._shared[2])

    @property
    def stage(self) -> Stage:
        """The stage that was begun last."""
        return self._stage or "setup"

    def _add_up(self, now: float) -> None:
        if self._stage is not None:
            self.seconds[self._stage] += now - self._since

    def begin_batch(self) -> None:
        """Forget the times of the last batch."""
        self._stage = None
        self.seconds = dict.fromkeys(STAGES, 0.0)

    def timings(self, keys: Sequence[EpisodeKey]) -> tuple[EpisodeTiming, ...]:
        """Return the times of the batch that has just ended, an equal share for each episode."""
        self._add_up(time.monotonic())
        self._stage = None
        share = {stage: seconds / len(keys) for stage, seconds in self.seconds.items()}
        return tuple(
            EpisodeTiming(
                key=key,
                total_seconds=sum(share.values()),
                reset_seconds=share["reset"],
                step_seconds=share["step"],
                inference_seconds=share["inference"],
            )
            for key in keys
        )


def write_stage(shared: SharedStage, stage: Stage, now: float) -> None:
    """Begin a stage; the time first, so that no reader sees a new stage with an old time."""
    shared[0] = now
    shared[1] = STAGES.index(stage)


def add_count(shared: SharedStage, amount: float) -> None:
    """Add to what was counted of the job."""
    shared[2] += amount


class Runner(Protocol):
    """What answers the jobs of a worker."""

    def answer(self, job: Any) -> object:  # Any: what the parent sends
        """Do the job; whatever goes wrong becomes a `Failed`."""

    def close(self) -> None:
        """Release the simulator."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunnerClass:
    """The class of a runner, by its name: the parent need not import what only a worker needs."""

    # `module:Class`, or a function that makes one; called with a heartbeat, a function that sends the
    # parent a `Notice`, and `options`
    target: str
    options: Mapping[str, Any] = field(default_factory=dict)  # Any: whatever it takes

    def make(self, heartbeat: Heartbeat, tell: Callable[[Notice], None]) -> Runner:
        """Import the class and make one."""
        module, _, name = self.target.partition(":")
        made: Runner = getattr(importlib.import_module(module), name)(heartbeat, tell, **self.options)
        return made


def worker_main(runner: RunnerClass, connection: Connection, shared: SharedStage, log: Path) -> None:
    """Answer the parent's jobs until it has no more; the entry point of a worker process."""
    detach(log)
    serve(connection, runner.make(Heartbeat(shared), functools.partial(send_message, connection)))


def serve(connection: Connection, runner: Runner) -> None:
    """Answer one job after the other until the parent sends None or closes the pipe."""
    try:
        while (job := connection.recv()) is not None:
            send_message(connection, runner.answer(job))
    except (EOFError, BrokenPipeError, ConnectionResetError) as exc:
        logger.warning("the parent is gone: %r", exc)
    runner.close()


def detach(log: Path) -> None:
    """Send all output to the log, and leave the terminal's signals to the parent."""
    os.setsid()  # Ctrl-C is for the parent, which then ends this process and all that it has started
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(descriptor, sys.__stdout__.fileno() if sys.__stdout__ else 1)
    os.dup2(descriptor, sys.__stderr__.fileno() if sys.__stderr__ else 2)
    os.close(descriptor)
    # Logs are read on terminals, too.
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is not None:  # as of a parent that closed it
            setattr(sys, name, cast(TextIO, PlainStream(getattr(sys, name))))
    faulthandler.enable(file=2, all_threads=True)
    faulthandler.register(signal.SIGUSR1, file=2, all_threads=True)  # the watchdog asks where it is stuck
    logging.basicConfig(
        level=logging.WARNING,
        format="%(asctime)s %(name)s %(levelname)s %(message)s",
        force=True,  # a library may have configured it in the fork server, for the stream before
    )
