"""Server processes of an evaluation, one per GPU; guarded like workers, they end with their parent."""

import functools
import logging
import os
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Self

from vla_eval.errors import VlaEvalError
from vla_eval.policies.compiled import Compilation
from vla_eval.serving.host import HostOptions, host_policy
from vla_eval.serving.metrics import ServerMetrics
from vla_eval.serving.server import ServerOptions, run_server
from vla_eval.wire.metadata import ServerMetadata
from vla_eval.workers.backend import Backend, Service
from vla_eval.workers.framing import BrokenMessageError, send_message
from vla_eval.workers.inside import SharedStage, add_count, detach
from vla_eval.workers.messages import Failed, as_exception, describe_error
from vla_eval.workers.process import CLOSE_SECONDS
from vla_eval.workers.start import VISIBLE_GPUS

KEY_VARIABLE = "MIKASA_VLA_SHARED_KEY"
"""Environment variable with the key of an evaluation's servers, for its workers."""
POLL_SECONDS = 0.05
NOTICE_SECONDS = 1.0  # until the end of a server is seen, after its connections have ended

logger = logging.getLogger(__name__)


class SharedServerError(VlaEvalError):
    """A server of an evaluation could not be started."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeJob:
    """What a server process is given: policy, key, address to bind, and the GPU that it may use."""

    host: HostOptions
    api_key: str
    address: str
    gpu: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerReady:
    """Clients can connect."""

    port: int
    metadata: ServerMetadata
    compiled: Compilation | None  # what it found of its compiled network


class SharedServers:
    """The servers of one policy; a context manager that leaves none behind."""

    def __init__(
        self,
        options: HostOptions,
        *,
        logs: Path,
        start_seconds: float,
        preload: Sequence[str],
        backend: Backend,
        stops: Callable[[], bool],
    ) -> None:
        self._options, self._start_seconds, self._stops = options, start_seconds, stops
        self._key = secrets.token_urlsafe(32)
        self._services = backend.services(serve_main, logs=logs, preload=preload)
        self._ready: list[ServerReady] = []

    @property
    def urls(self) -> str:
        """The addresses, with commas."""
        return ",".join(
            f"ws://{service.address}:{ready.port}"
            for service, ready in zip(self._services, self._ready, strict=True)
        )

    @property
    def metadata(self) -> ServerMetadata:
        """Metadata of the servers."""
        return self._ready[0].metadata

    @property
    def compiled(self) -> tuple[Compilation, ...]:
        """What the servers found of their compiled networks."""
        return tuple(ready.compiled for ready in self._ready if ready.compiled is not None)

    @property
    def was_stopped(self) -> bool:
        """Whether it was given up before all servers were ready."""
        return len(self._ready) < len(self._services)

    def one_has_ended(self) -> bool:
        """Whether a server is there no longer; asked after an error of a connection."""
        deadline = time.monotonic() + NOTICE_SECONDS
        while not any(service.wait(0.0) is not None for service in self._services):
            if time.monotonic() > deadline:
                return False
            time.sleep(POLL_SECONDS)
        return True

    def __enter__(self) -> Self:
        """Start all servers and wait for them; workers that start now know the key."""
        os.environ[KEY_VARIABLE] = self._key
        try:
            for service in self._services:
                service.give(
                    ServeJob(host=self._options, api_key=self._key, address=service.address, gpu=service.gpu)
                )
            for service in self._services:
                ready = self._wait_for(service)
                if ready is None:
                    break
                self._ready.append(ready)
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End all servers: gently after success, at once after an exception."""
        if kind is None:
            for service in self._services:
                service.ask_to_close()
            deadline = time.monotonic() + CLOSE_SECONDS
            for service in self._services:
                service.wait(max(0.0, deadline - time.monotonic()))
        self._end()

    def _end(self) -> None:
        os.environ.pop(KEY_VARIABLE, None)
        for service in self._services:
            service.ask_to_end()
        for service in self._services:
            service.end()

    def _wait_for(self, service: Service) -> ServerReady | None:
        """Return what a server says when it is ready; None if the caller stops."""
        deadline = time.monotonic() + self._start_seconds
        while not self._stops():
            try:
                messages = service.read()
            except (EOFError, OSError, BrokenMessageError) as exc:
                raise self._not_started(service, f"ended ({exc!r})") from exc
            for message in messages:
                if isinstance(message, ServerReady):
                    return message
                if isinstance(message, Failed):
                    raise as_exception(message.error)
            if service.start_error is not None:
                raise self._not_started(service, f"could not be started: {service.start_error!r}")
            if time.monotonic() > deadline:
                what = f"was not ready after {self._start_seconds:g} s (timeouts.setup_seconds)"
                raise self._not_started(service, what)
            time.sleep(POLL_SECONDS)
        return None

    def _not_started(self, service: Service, what: str) -> SharedServerError:
        return SharedServerError(
            f"the server of policy '{self._options.policy}' {what}. Its output is in {service.log}. To infer "
            f"in the workers instead: --set inference=in_process\n{service.tail() or ''}"
        )


def serve_main(connection: Connection, shared: SharedStage, log: Path) -> None:
    """Serve a policy for the parent until it closes the connection; the entry point of the process."""
    detach(log)
    logging.getLogger("vla_eval.serving").setLevel(logging.INFO)
    job: ServeJob = connection.recv()
    if job.gpu is not None:
        os.environ[VISIBLE_GPUS] = job.gpu  # before torch looks for GPUs
    try:
        hosted = host_policy(job.host)
        run_server(
            hosted,
            ServerOptions(host=job.address, port=0, api_key=job.api_key),
            ready=lambda port, compiled: send_message(
                connection, ServerReady(port=port, metadata=hosted.metadata, compiled=compiled)
            ),
            ends=lambda: _wait_for_parent(connection),
            metrics=ServerMetrics(on_pass=functools.partial(add_count, shared)),
        )
    except BaseException as exc:  # also SystemExit: a policy must not end the server unseen
        logger.exception("the server ends")
        send_message(connection, Failed(error=describe_error(exc, "setup"), refused=False))


def _wait_for_parent(connection: Connection) -> None:
    try:
        connection.recv()
    except (EOFError, OSError):
        logger.info("the parent is gone")
