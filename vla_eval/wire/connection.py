"""One connection to a policy server: whole messages out and in; closed for good after any error."""

import logging
import time
from collections.abc import Collection
from contextlib import ExitStack, suppress
from typing import Any  # Any: a message may hold anything

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from vla_eval.errors import RemoteConnectionError, RemotePolicyError, RemoteReplyError, RemoteTimeoutError
from vla_eval.lock.switch import own_need
from vla_eval.wire.addresses import is_loopback
from vla_eval.wire.codec import MAX_MESSAGE_BYTES, CodecError, packb, unpackb
from vla_eval.wire.keys import key_headers, key_problem

logger = logging.getLogger(__name__)

OPEN_SECONDS = 10.0  # for the handshake, once somebody listens
CLOSE_SECONDS = 1.0
FIRST_PAUSE_SECONDS, LAST_PAUSE_SECONDS = 0.1, 2.0  # between attempts to connect
MAX_SHOWN_ERROR = 2_000  # characters of a server's error that a message repeats
HTTP_UNAUTHORIZED = (401, 403)


class Connection:
    """A connection to one server; used by one thread. For `text_markers`, see `codec.packb`."""

    def __init__(
        self,
        url: str,
        *,
        timeout_seconds: float,
        connect_seconds: float = 0.0,
        api_key: str | None = None,
        text_markers: bool = False,
    ) -> None:
        self.url = url
        self._timeout_seconds = timeout_seconds
        self._text_markers = text_markers
        self._opened = ExitStack()  # leaving it closes the connection
        with own_need():  # the user named this server
            opened = _connect(url, connect_seconds=connect_seconds, api_key=api_key)
        self._socket = self._opened.enter_context(opened)

    def send(self, message: Any) -> None:
        """Send a message; a `RemoteConnectionError` if the connection is lost, or closed by an error."""
        try:
            self._socket.send(packb(message, text_markers=self._text_markers))
        except CodecError as exc:
            raise self._failed(RemoteReplyError, f"the request cannot be sent: {exc}.") from exc
        except (ConnectionClosed, OSError) as exc:
            raise self._lost(exc) from exc

    def receive(self, *, accept_text: Collection[str] = ()) -> Any:
        """Return the next message, or a frame of text that is in `accept_text`."""
        try:
            frame = self._socket.recv(timeout=self._timeout_seconds)
        except TimeoutError as exc:
            raise self._failed(
                RemoteTimeoutError,
                f"no reply within {self._timeout_seconds:g} s. The connection is closed, since a late reply "
                f"would be taken for the next one. Check the server's log, or raise timeout_seconds in the "
                f"policy's recipe.",
            ) from exc
        except (ConnectionClosed, OSError) as exc:
            raise self._lost(exc) from exc
        if isinstance(frame, str):
            if frame in accept_text:
                return frame
            raise self._failed(RemoteReplyError, f"the server replied with an error: {_shortened(frame)}")
        try:
            return unpackb(frame)
        except CodecError as exc:
            raise self.refuse(f"{exc}. Is it a policy server?") from exc

    def refuse(self, problem: str) -> RemoteReplyError:
        """Close the connection, and return the error for a reply that is not what was asked."""
        self.close()
        return RemoteReplyError(f"{self.url}: a reply that cannot be used: {problem}")

    def close(self) -> None:
        """Close the connection; a second time does nothing."""
        with suppress(WebSocketException, OSError):  # it may be lost already
            self._opened.close()

    def _failed(self, error: type[RemotePolicyError], problem: str) -> RemotePolicyError:
        self.close()
        return error(f"{self.url}: {problem}")

    def _lost(self, exc: Exception) -> RemotePolicyError:
        reason = ""
        if isinstance(exc, ConnectionClosed) and exc.rcvd is not None:
            reason = f" by the server (code {exc.rcvd.code}{exc.rcvd.reason and ', '}{exc.rcvd.reason:.200})"
        return self._failed(
            RemoteConnectionError,
            f"the connection was closed{reason}. See the server's log, and start it again if it has "
            f"ended; the same command then resumes.",
        )


def _connect(url: str, *, connect_seconds: float, api_key: str | None) -> ClientConnection:
    problem = None if api_key is None else key_problem(api_key)
    if problem is not None:
        raise RemoteConnectionError(
            f"{url}: the API key cannot be sent: {problem}. Correct the environment variable that holds it."
        )
    deadline, pause = time.monotonic() + connect_seconds, FIRST_PAUSE_SECONDS
    while True:
        try:
            return connect(
                url,
                additional_headers=key_headers(api_key),
                compression=None,
                max_size=MAX_MESSAGE_BYTES,
                open_timeout=OPEN_SECONDS,
                close_timeout=CLOSE_SECONDS,
                # A server that computes for a minute answers no pings, and is healthy.
                ping_interval=None,
                proxy=None if is_loopback(url) else True,
            )
        except ConnectionRefusedError as exc:
            if time.monotonic() + pause > deadline:
                raise _no_server(url, exc) from exc
            logger.info("%s: nobody listens yet; trying again in %.1f s", url, pause)
        except InvalidStatus as exc:
            raise _refused(url, exc) from exc
        except (InvalidHandshake, OSError, UnicodeError, TimeoutError) as exc:
            raise _no_server(url, exc) from exc
        time.sleep(pause)
        pause = min(2 * pause, LAST_PAUSE_SECONDS)


def _no_server(url: str, exc: Exception) -> RemoteConnectionError:
    problem = getattr(exc, "strerror", None) or str(exc) or type(exc).__name__
    return RemoteConnectionError(
        f"{url}: expected a policy server, found none ({problem:.200}). Start it (`mikasa-vla serve "
        f"--policy NAME`), or correct the address."
    )


def _refused(url: str, exc: InvalidStatus) -> RemoteConnectionError:
    status = exc.response.status_code
    key = " It wants an API key: set the environment variable of `api_key_env`, see docs/remote.md."
    hint = key if status in HTTP_UNAUTHORIZED else ""
    return RemoteConnectionError(f"{url}: the server refuses the connection (HTTP {status}).{hint}")


def _shortened(text: str) -> str:
    """Return a server's error; of a long traceback the end, which says what it is."""
    text = text.strip()
    return text if len(text) <= MAX_SHOWN_ERROR else f"… {text[-MAX_SHOWN_ERROR:]}"
