"""The inside of a cluster's actor: a pool of one worker process, with its watchdog, or one policy server."""

import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vla_eval.workers.jobs import Answered, Job, JobList
from vla_eval.workers.local import LocalService
from vla_eval.workers.messages import Failed, Notice
from vla_eval.workers.pool import WorkerPool
from vla_eval.workers.process import CLOSE_SECONDS, WorkerMain, WorkerSpec
from vla_eval.workers.start import NEAR_VARIABLE, worker_context

OWN_VARIABLES = "MIKASA_VLA_"
"""How the environment variables begin that travel with a job."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """What an actor takes over from the driver."""

    folder: str  # the driver's working directory, which relative paths in jobs begin at
    variables: Mapping[str, str]
    path: tuple[str, ...]  # where it imports from, for a policy's own module
    logs: str  # the driver's folder of logs; used where the storage is shared

    def enter(self, address: str) -> Path:
        """Take it over on the machine with this address; return the folder of logs."""
        os.environ.update({**self.variables, NEAR_VARIABLE: address})
        if Path(self.folder).is_dir():
            os.chdir(self.folder)
        sys.path += [folder for folder in self.path if folder not in sys.path]
        # Ray's own entry point: each child would import it again, and Ray with it.
        vars(sys.modules["__main__"]).pop("__file__", None)
        shared = Path(self.logs)
        return shared if shared.is_dir() else Path(tempfile.mkdtemp(prefix="mikasa-vla-logs-"))


class WorkerActor[J: Job, A]:
    """A pool of one process; lives as long as its process's jobs last."""

    def __init__(self, spec: WorkerSpec, place: Place, index: int, address: str) -> None:
        spec = replace(spec, logs=place.enter(address))
        self._pool: WorkerPool[J, A] = WorkerPool(spec, size=1, first_index=index)

    def ready(self) -> None:
        """Return once the actor is there."""

    def do(self, jobs: Sequence[J]) -> list[A | Failed | Notice]:
        """Do jobs of one setup key; return their answers, in order, and between them what was found."""
        events = [event for event in self._pool.run(JobList(jobs)) if event is not None]
        return [event.answer if isinstance(event, Answered) else event for event in events]

    def close(self) -> None:
        """Close the simulator and end the process."""
        self._pool.__exit__(None, None, None)


class ServiceActor(LocalService):
    """A policy server's process; see `Service`."""

    def __init__(
        self, main: WorkerMain, preload: tuple[str, ...], place: Place, index: int, address: str
    ) -> None:
        log = place.enter(address) / f"server-{index}.log"
        super().__init__(main, worker_context(preload=preload), index=index, log=log)

    def read(self) -> list[object]:
        """Return what it has sent; see `Service.read`."""
        if self.start_error is not None:
            raise self.start_error
        return super().read()

    def busy_seconds(self) -> float:
        """Return how long it has been in forward passes."""
        return self.count

    def close(self) -> None:
        """Have it end by itself, then kill it."""
        self.ask_to_close()
        self.wait(CLOSE_SECONDS)
        self.end()
