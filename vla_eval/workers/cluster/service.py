"""A policy server on a machine of a cluster, seen from the driver."""

import contextlib
import time
from pathlib import Path
from typing import Any  # Ray is optional: not looked at by mypy

from vla_eval.workers.cluster.actor import Place, ServiceActor
from vla_eval.workers.cluster.connect import on_machine
from vla_eval.workers.cluster.machines import Machine
from vla_eval.workers.process import CLOSE_SECONDS, END_SECONDS, WorkerMain

KILLED = -9
SHARE_SECONDS = 5.0  # between two questions for the time in forward passes


class ClusterService:
    """An actor with a guarded process, see `Service`; for a GPU, Ray sets `CUDA_VISIBLE_DEVICES`."""

    gpu: str | None = None

    def __init__(
        self,
        ray: Any,
        machine: Machine,
        main: WorkerMain,
        *,
        preload: tuple[str, ...],
        place: Place,
        index: int,
        has_gpu: bool,
        address: str,
    ) -> None:
        self.address = address
        self.log = Path(place.logs) / f"server-{index}.log"
        self.start_error: BaseException | None = None
        self._ray, self._machine = ray, machine
        self._closing: Any = None
        actor = ray.remote(ServiceActor).options(
            max_restarts=0,
            max_task_retries=0,
            num_cpus=0,
            num_gpus=1 if has_gpu else 0,
            scheduling_strategy=on_machine(machine.node),
        )
        self._actor = actor.remote(main, preload, place, index, machine.address)
        self._reading: Any = None
        self._asked: tuple[float, Any] | None = None  # when, and the call
        # When it was asked last, and how long it had been in forward passes by then.
        self._busy_at, self._busy_seconds = time.monotonic(), 0.0
        self._share: float | None = None
        machine.services.append(self)

    def give(self, job: object) -> None:
        """Start the process with its job; returns at once."""
        self._actor.give.remote(job)

    def read(self) -> list[object]:
        """Return what it has sent since the last call; see `Service.read`."""
        if self._reading is None:
            self._reading = self._actor.read.remote()
        ready, _ = self._ray.wait([self._reading], timeout=0)
        if not ready:
            return []
        reading, self._reading = self._reading, None
        try:
            messages: list[object] = self._ray.get(reading)
        except self._ray.exceptions.RayTaskError as exc:
            raise exc.cause from exc
        except self._ray.exceptions.RayError as exc:
            raise EOFError(f"the actor on {self._machine.name} has died: {exc}") from exc
        return messages

    def busy_share(self) -> float | None:
        """Return its share of time in forward passes of late; never waits for an answer."""
        now = time.monotonic()
        if self._asked is None and now - self._busy_at >= SHARE_SECONDS:
            self._asked = now, self._actor.busy_seconds.remote()
        if self._asked is not None:
            at, call = self._asked
            ready, _ = self._ray.wait([call], timeout=0)
            if ready:
                self._asked = None
                with contextlib.suppress(self._ray.exceptions.RayError):  # it has died, which others notice
                    seconds: float = self._ray.get(call)
                    self._share = min(1.0, (seconds - self._busy_seconds) / (at - self._busy_at))
                    self._busy_at, self._busy_seconds = at, seconds
        return self._share

    def wait(self, seconds: float) -> int | None:
        """Wait for its end; return its exit code if there is one."""
        if self._closing is not None:
            ready, _ = self._ray.wait([self._closing], timeout=seconds)
            return 0 if ready else None
        try:
            code: int | None = self._ray.get(self._actor.wait.remote(seconds), timeout=seconds + END_SECONDS)
        except self._ray.exceptions.GetTimeoutError:
            return None
        except self._ray.exceptions.RayError:
            return KILLED
        return code

    def ask_to_close(self) -> None:
        """Have it end by itself."""
        self._closing = self._actor.close.remote()

    def ask_to_end(self) -> None:
        """Have it killed with whatever it has started: its guard sees that the actor is gone."""
        with contextlib.suppress(self._ray.exceptions.RayError):
            self._ray.kill(self._actor, no_restart=True)

    def end(self) -> None:
        """Kill it, and wait until Ray has noticed."""
        self.ask_to_end()
        if self in self._machine.services:
            self._machine.services.remove(self)
        deadline = time.monotonic() + CLOSE_SECONDS
        while time.monotonic() < deadline and self._closing is None and self.wait(0.0) is None:
            time.sleep(0.05)

    def tail(self) -> str | None:
        """Return the end of what it has written."""
        try:
            text: str | None = self._ray.get(self._actor.tail.remote(), timeout=END_SECONDS)
        except self._ray.exceptions.RayError:
            return None
        return text
