"""The server: WebSocket connections, health and metrics over HTTP, the API key, and a graceful stop.

Binary messages of msgpack, as openpi's client sends them; `docs/serve.md` has the protocol. No pings: they
close healthy connections of a client that is busy simulating.
"""

import asyncio
import contextlib
import hmac
import http
import itertools
import logging
import signal
import threading
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from vla_eval.bounds import MAX_SECONDS, check_bounds
from vla_eval.errors import VlaEvalError
from vla_eval.serving.batching import Batcher
from vla_eval.serving.connection import ClientConnection, Service
from vla_eval.serving.host import HostedPolicy
from vla_eval.serving.metrics import CONTENT_TYPE, ServerMetrics
from vla_eval.serving.sessions import SessionTable
from vla_eval.wire.codec import MAX_MESSAGE_BYTES

MAX_PORT = 65_535
GOING_AWAY = 1001  # close code of RFC 6455
CLOSE_SECONDS = 5.0  # for a client to take its reply, and then to answer the closing of its connection
LOG_SECONDS = 60.0
IDLE_CHECKS = 4  # per idle time
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)

logger = logging.getLogger(__name__)


class ServeError(VlaEvalError):
    """The server cannot be started."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerOptions:
    """Where and how to serve.

    Attributes:
        host: address to listen on.
        port: TCP port; 0: a free one.
        api_key: what clients must send; None: nothing.
        idle_seconds: sessions without a message for so long are dropped.
        debug: send errors with their traceback.
        log_seconds: time between two lines of statistics.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    api_key: str | None = None
    idle_seconds: float = 600.0
    debug: bool = False
    log_seconds: float = LOG_SECONDS

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_bounds(self, {"port": (0, MAX_PORT), "idle_seconds": (0.001, MAX_SECONDS)})


class PolicyServer:
    """Serves one policy until it is stopped.

    Args:
        hosted: the policy.
        options: where and how.
        metrics: counts what is done; None: new ones.
    """

    def __init__(
        self, hosted: HostedPolicy, options: ServerOptions, metrics: ServerMetrics | None = None
    ) -> None:
        self._hosted, self._options = hosted, options
        self._metrics = metrics or ServerMetrics()
        self._sessions = SessionTable(
            hosted.reader, reads=hosted.policy.spec.reads, n_rows=hosted.n_rows, task=hosted.task
        )
        self._batcher = Batcher(hosted.policy, n_rows=hosted.n_rows, metrics=self._metrics)
        self._service = Service(sessions=self._sessions, batcher=self._batcher, debug=options.debug)
        self._connections: set[ClientConnection] = set()
        self._numbers = itertools.count()

    async def run(self, stop: asyncio.Event, ready: Callable[[int], None]) -> None:
        """Serve until `stop` is set; then finish the pass under way, and close all connections.

        Args:
            stop: set by the caller to end.
            ready: called once with the port when clients can connect.

        Raises:
            ServeError: the address cannot be listened on.
        """
        try:
            server = await self._listen()
        except (OSError, UnicodeError) as exc:
            self._batcher.close()
            raise ServeError(
                f"cannot listen on {self._options.host}:{self._options.port}: {exc}. Choose another --port "
                "(0: a free one), or another --host."
            ) from exc
        tasks = [asyncio.create_task(task()) for task in (self._log, self._drop_idle)]
        try:
            ready(int(next(iter(server.sockets)).getsockname()[1]))
            await stop.wait()
        finally:
            for task in tasks:
                task.cancel()
            await self._close(server)

    def _listen(self) -> Awaitable[Server]:
        return serve(
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

    async def _close(self, server: Server) -> None:
        await asyncio.get_running_loop().run_in_executor(None, self._batcher.close)
        await asyncio.gather(*(connection.finish_replies(CLOSE_SECONDS) for connection in self._connections))
        server.close(code=GOING_AWAY, reason="the server is stopping")
        await server.wait_closed()

    async def _serve_client(self, socket: ServerConnection) -> None:
        connection = ClientConnection(socket, next(self._numbers), self._service)
        self._connections.add(connection)
        try:
            await connection.serve(replace(self._hosted.metadata, n_sessions=len(self._sessions)))
        finally:
            self._connections.discard(connection)

    def _answer_http(self, socket: ServerConnection, request: Request) -> Response | None:
        """Answer what is no WebSocket, refuse browsers and clients without the key; None: a WebSocket."""
        if request.path == "/healthz":
            return socket.respond(http.HTTPStatus.OK, "OK\n")
        # Browsers send it: any page that is open could talk to a server on the loopback address.
        if "Origin" in request.headers:
            return socket.respond(
                http.HTTPStatus.FORBIDDEN, "expected a policy client, found a page in a browser (Origin)\n"
            )
        key = self._options.api_key
        given = request.headers.get("Authorization", "")
        if key is not None and not hmac.compare_digest(given.encode(), f"Api-Key {key}".encode()):
            return socket.respond(
                http.HTTPStatus.UNAUTHORIZED, "expected the header 'Authorization: Api-Key KEY'\n"
            )
        if request.path == "/metrics":
            body = self._metrics.prometheus(
                n_sessions=len(self._sessions), n_connections=len(self._connections)
            ).encode()
            headers = Headers({"Content-Type": CONTENT_TYPE, "Content-Length": str(len(body))})
            return Response(http.HTTPStatus.OK, "OK", headers, body)
        return None

    async def _log(self) -> None:
        while True:
            await asyncio.sleep(self._options.log_seconds)
            logger.info("%s", self._metrics.line(n_sessions=len(self._sessions)))

    async def _drop_idle(self) -> None:
        while True:
            await asyncio.sleep(self._options.idle_seconds / IDLE_CHECKS)
            for slot in self._sessions.drop_idle(self._options.idle_seconds):
                self._batcher.forget(slot)


def run_server(
    hosted: HostedPolicy,
    options: ServerOptions,
    *,
    ready: Callable[[int], None],
    ends: Callable[[], None] | None = None,
    metrics: ServerMetrics | None = None,
) -> None:
    """Serve until SIGINT or SIGTERM; a second one ends the process at once.

    Args:
        hosted: the policy.
        options: where and how.
        ready: called once with the port when clients can connect.
        ends: called in a thread of its own; when it returns, the server stops as well.
        metrics: counts what is done; None: new ones.

    Raises:
        ServeError: the address cannot be listened on.
    """

    async def serve_until_stopped() -> None:
        loop, stop = asyncio.get_running_loop(), asyncio.Event()

        def on_signal() -> None:
            stop.set()
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
        await PolicyServer(hosted, options, metrics).run(stop, ready)

    asyncio.run(serve_until_stopped())
