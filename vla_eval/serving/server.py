"""The server: WebSocket connections, health and metrics over HTTP, the API key, and a graceful stop.

Binary messages of msgpack, as openpi's client sends them; `docs/serve.md` has the protocol. No pings: they
close healthy connections of a client that is busy simulating.
"""

import asyncio
import contextlib
import faulthandler
import functools
import http
import itertools
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from vla_eval.errors import VlaEvalError
from vla_eval.policies.compiled import Compilation
from vla_eval.serving.asked_sentences import AskedSentences
from vla_eval.serving.batching import Batcher
from vla_eval.serving.connection import ClientConnection, Service
from vla_eval.serving.host import HostedPolicy
from vla_eval.serving.metrics import CONTENT_TYPE, ServerMetrics
from vla_eval.serving.sessions import SessionTable
from vla_eval.strict.bounds import MAX_SECONDS, check_bounds
from vla_eval.wire.codec import MAX_MESSAGE_BYTES
from vla_eval.wire.keys import HEADER, explanation, key_problem, refused

MAX_PORT = 65_535
GOING_AWAY = 1001  # close code of RFC 6455
# Of a stop, one after the other; a service that is stopped has 10 s before it is killed.
PASS_SECONDS = 4.0  # for the pass under way; then the policy is left alone
REPLY_SECONDS = 1.5  # for clients to take their replies
CLOSE_SECONDS = 1.5  # for clients to answer the closing of their connections; then they are cut
END_SECONDS = 9.0  # for all of it and the end of the process, which is then ended as it is
LOG_SECONDS = 60.0  # between two lines of statistics
IDLE_CHECKS = 4  # per idle time
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
STDERR_FD = 2
HAS_ORIGIN = (
    "it has the header Origin, which browsers send for a page; pages are refused. If the client is a program,"
    " leave that header out (websocket-client: suppress_origin=True)."
)
EXIT_UNANSWERED = 1  # of a server whose policy was still computing when it ended

Ready = Callable[[int, Compilation | None], None]
"""Called with the port, and with what was found of a network that was compiled."""

logger = logging.getLogger(__name__)


class ServeError(VlaEvalError):
    """The server cannot be started."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerOptions:
    """Where and how to serve.

    Attributes:
        port: TCP port; 0: a free one.
        api_key: what clients must send; None: nothing.
        idle_seconds: sessions without a message for so long are dropped.
        debug: send errors with their traceback.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    api_key: str | None = None
    idle_seconds: float = 600.0
    debug: bool = False

    def __post_init__(self) -> None:
        check_bounds(self, {"port": (0, MAX_PORT), "idle_seconds": (0.001, MAX_SECONDS)})
        problem = None if self.api_key is None else key_problem(self.api_key)
        if problem is not None:
            raise ServeError(f"the API key: {problem}. Choose another key.")


class PolicyServer:
    """Serves one policy until it is stopped."""

    def __init__(
        self,
        hosted: HostedPolicy,
        options: ServerOptions,
        metrics: ServerMetrics | None = None,
    ) -> None:
        self._hosted, self._options = hosted, options
        self._metrics = metrics or ServerMetrics()
        self._batcher = Batcher(
            hosted.policy,
            n_rows=hosted.n_rows,
            action_dims=hosted.metadata.action_dims or (),
            metrics=self._metrics,
            prepare=hosted.warm_up,
        )
        self._sessions = SessionTable(
            hosted.reader,
            reads=hosted.policy.spec.reads,
            n_rows=hosted.n_rows,
            task=hosted.task,
            forget=self._batcher.forget,
        )
        self._service = Service(
            sessions=self._sessions,
            batcher=self._batcher,
            sentences=AskedSentences(hosted),
            debug=options.debug,
        )
        self._connections: set[ClientConnection] = set()
        self._numbers = itertools.count()
        self._is_stopping = False

    async def _is_prepared(self, stop: asyncio.Event) -> bool:
        """Wait until the policy can be asked; False: it was stopped meanwhile."""
        prepared = asyncio.wrap_future(self._batcher.prepared)
        stopped = asyncio.ensure_future(stop.wait())
        waiting: set[asyncio.Future[Any]] = {prepared, stopped}
        await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        stopped.cancel()
        if prepared.done():
            prepared.result()  # raises what went wrong
        return prepared.done()

    async def run(self, stop: asyncio.Event, ready: Ready) -> bool:
        """Serve until `stop` is set; then finish the pass under way, and close all connections.

        Compiles the policy's network before, if that was asked for. Calls `ready` once when clients can
        connect. Returns whether the policy has answered; if not, its thread still runs.

        Raises:
            ServeError: the address cannot be listened on.
        """
        if not await self._is_prepared(stop):
            return False
        try:
            server = await serve(
                self._serve_client,
                self._options.host,
                self._options.port,
                process_request=self._answer_http,
                compression=None,  # images are large and the network is near
                max_size=MAX_MESSAGE_BYTES,
                ping_interval=None,
                close_timeout=CLOSE_SECONDS,
                server_header=None,
            )
        except (OSError, UnicodeError) as exc:
            self._batcher.close()
            raise ServeError(
                f"cannot listen on {self._options.host}:{self._options.port}: {exc}. Choose another --port "
                "(0: a free one), or another --host."
            ) from exc
        tasks = [asyncio.create_task(task()) for task in (self._log, self._drop_idle)]
        try:
            port = int(next(iter(server.sockets)).getsockname()[1])
            ready(port, self._batcher.prepared.result())
            await stop.wait()
        finally:
            for task in tasks:
                task.cancel()
            has_ended = await self._close(server)
        return has_ended

    async def _close(self, server: Server) -> bool:
        self._is_stopping = True
        close = functools.partial(self._batcher.close, seconds=PASS_SECONDS)
        has_ended = await asyncio.get_running_loop().run_in_executor(None, close)
        if not has_ended:
            logger.warning("the policy has not answered for %g s: ending without its reply", PASS_SECONDS)
        await asyncio.gather(*(connection.finish_replies(REPLY_SECONDS) for connection in self._connections))
        server.close(code=GOING_AWAY, reason="the server is stopping")
        with contextlib.suppress(TimeoutError):  # clients that read nothing are cut with the process
            await asyncio.wait_for(server.wait_closed(), 2 * CLOSE_SECONDS)
        return has_ended

    async def _serve_client(self, socket: ServerConnection) -> None:
        connection = ClientConnection(socket, next(self._numbers), self._service)
        self._connections.add(connection)
        try:
            await connection.serve(replace(self._hosted.metadata, n_sessions=len(self._sessions)))
        finally:
            self._connections.discard(connection)

    def _answer_http(self, socket: ServerConnection, request: Request) -> Response | None:
        """Answer anything but a WebSocket, refuse browsers and clients without the key; None: a WebSocket."""
        if request.path == "/healthz":
            return socket.respond(http.HTTPStatus.OK, "OK\n")
        if self._is_stopping:
            return socket.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "the server is stopping\n")
        # Browsers send it: any page that is open could talk to a server on the loopback address.
        if "Origin" in request.headers:
            logger.warning(
                "refused a connection from %s: %s", (socket.remote_address or ("",))[0], HAS_ORIGIN
            )
            return socket.respond(http.HTTPStatus.FORBIDDEN, f"{HAS_ORIGIN}\n")
        status = refused(request.headers.get_all(HEADER), self._options.api_key)
        if status is not None:
            return socket.respond(status, explanation(status))
        if request.path == "/metrics":
            body = self._metrics.prometheus(
                n_sessions=len(self._sessions), n_connections=len(self._connections)
            ).encode()
            headers = Headers({"Content-Type": CONTENT_TYPE, "Content-Length": str(len(body))})
            return Response(http.HTTPStatus.OK, "OK", headers, body)
        return None

    async def _log(self) -> None:
        while True:
            await asyncio.sleep(LOG_SECONDS)
            logger.info("%s", self._metrics.line(n_sessions=len(self._sessions)))

    async def _drop_idle(self) -> None:
        while True:
            await asyncio.sleep(self._options.idle_seconds / IDLE_CHECKS)
            self._sessions.drop_idle(self._options.idle_seconds)


def run_server(
    hosted: HostedPolicy,
    options: ServerOptions,
    *,
    ready: Ready,
    ends: Callable[[], None] | None = None,
    metrics: ServerMetrics | None = None,
) -> None:
    """Serve until SIGINT or SIGTERM; a second one ends the process at once.

    Within `END_SECONDS` of the first one the process has ended, whatever the policy does. `ready` is called
    once when clients can connect. `ends` is called in a thread of its own: when it returns, the server stops
    as well. Errors are those of `PolicyServer.run`.
    """

    async def serve_until_stopped() -> bool:
        loop, stop = asyncio.get_running_loop(), asyncio.Event()

        def on_signal() -> None:
            stop.set()
            # In C: ends the process even if a policy, or the end of a library, blocks Python.
            faulthandler.dump_traceback_later(END_SECONDS, exit=True, file=STDERR_FD)
            for number in STOP_SIGNALS:
                loop.remove_signal_handler(number)

        for number in STOP_SIGNALS:
            loop.add_signal_handler(number, on_signal)
        if ends is not None:
            wait_for_end = ends

            def watch() -> None:
                wait_for_end()
                with contextlib.suppress(RuntimeError):  # the loop has ended before
                    loop.call_soon_threadsafe(stop.set)

            threading.Thread(target=watch, name="end of serving", daemon=True).start()
        return await PolicyServer(hosted, options, metrics).run(stop, ready)

    has_ended = asyncio.run(serve_until_stopped())
    if not has_ended:  # Python would wait for its thread, or for threads that it has started
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(EXIT_UNANSWERED)
