"""One client's connection: requests are read in order, replies are sent as they are ready."""

import asyncio
import logging
import time
import traceback
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, cast  # Any: what a client sends

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from vla_eval.core import EpisodeStart, MemoryArrays
from vla_eval.errors import VlaEvalError, did_you_mean
from vla_eval.serving.asked_sentences import AskedSentences
from vla_eval.serving.batching import Batcher, Inference
from vla_eval.serving.observations import RequestError
from vla_eval.serving.sessions import Session, SessionTable
from vla_eval.strict.json_text import shown
from vla_eval.wire.client import READING_KEY
from vla_eval.wire.codec import CodecError, packb, unpackb
from vla_eval.wire.metadata import ServerMetadata
from vla_eval.wire.numbers import GET_MEMORY, MEMORY, SET_MEMORY, memory_problem

ENDPOINTS = ("infer", "reset", "observe", GET_MEMORY, SET_MEMORY)
MAX_PENDING = 1024  # requests of a connection without a reply
INTERNAL_ERROR = 1011  # close code of RFC 6455, as openpi's server uses it
MAX_ERROR_CHARACTERS = 4000

_Done = Future[Inference] | Future[None] | Future[MemoryArrays | None]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Service:
    """What all connections of a server share; `debug`: errors are sent with their traceback."""

    sessions: SessionTable
    batcher: Batcher
    sentences: AskedSentences
    debug: bool


class ClientConnection:
    """Answers the requests of one connection, whose number no other one has."""

    def __init__(self, socket: ServerConnection, number: int, service: Service) -> None:
        self._socket, self._number, self._service = socket, number, service
        self._address = str((socket.remote_address or ("",))[0])  # None: it is gone already
        self._replies: set[asyncio.Task[None]] = set()
        self._previous_seconds: float | None = None
        self._has_failed = False
        self._told: set[str] = set()  # sentences of which this client knows what was read

    async def serve(self, metadata: ServerMetadata) -> None:
        """Say what is served, and answer until the connection ends; then drop its sessions."""
        try:
            await self._socket.send(packb(metadata.to_wire()))
            async for data in self._socket:
                try:
                    self._take(data)
                except VlaEvalError as exc:
                    await self._fail(exc)
        except ConnectionClosed:
            pass  # the client is gone, or the server stops
        finally:
            for reply in self._replies:
                reply.cancel()
            self._service.sessions.drop_connection(self._number)

    async def finish_replies(self, seconds: float) -> None:
        """Wait until the policy's answers are sent, but not for long: a client may not read."""
        if self._replies:
            await asyncio.wait(self._replies, timeout=seconds)

    def _take(self, data: str | bytes) -> None:
        """Begin to answer a request, or raise `RequestError`."""
        if self._has_failed:  # the connection is being closed
            return
        request, begun = _read(data), time.monotonic()
        endpoint = request.get("endpoint") or "infer"
        if endpoint not in ENDPOINTS:
            hint = did_you_mean(endpoint, ENDPOINTS) if isinstance(endpoint, str) else ""
            raise RequestError(f"'endpoint': expected {', '.join(ENDPOINTS)}; found {shown(endpoint)}.{hint}")
        if len(self._replies) >= MAX_PENDING:
            raise RequestError(f"expected at most {MAX_PENDING} requests without a reply.")
        sessions, batcher = self._service.sessions, self._service.batcher
        session = sessions.session(self._number, request, address=self._address)
        if endpoint == "reset":
            start = self._begin(session, request)
            self._answer_later(session, request, batcher.begin(start), begun)
        elif endpoint == "observe":
            if session.episode is None:
                raise RequestError("'observe' without an episode. Send 'reset' first.")
            sessions.observe(session, request)
        elif endpoint in (GET_MEMORY, SET_MEMORY):
            memory = _memory(request) if endpoint == SET_MEMORY else None
            if session.episode is None:
                raise RequestError(f"'{endpoint}' without an episode. Send 'reset' first.")
            self._answer_later(session, request, batcher.memory(session.slot, memory), begun)
        else:
            if sessions.begins(session, request):
                batcher.begin(self._begin(session, request))  # if it fails, so does the inference
            assert session.episode is not None
            window = sessions.window(session, request)
            self._answer_later(session, request, batcher.infer(session.episode, window), begun)

    def _begin(self, session: Session, request: Mapping[str, Any]) -> EpisodeStart:
        start = self._service.sessions.begin(session, request)
        self._service.sentences.begin(start)
        return start

    def _answer_later(self, session: Session, request: Mapping[str, Any], done: _Done, begun: float) -> None:
        session.n_pending += 1
        task = asyncio.create_task(self._answer(session, request, done, begun, session.episode))
        self._replies.add(task)
        task.add_done_callback(self._replies.discard)

    async def _answer(
        self,
        session: Session,
        request: Mapping[str, Any],
        done: _Done,
        begun: float,
        start: EpisodeStart | None,
    ) -> None:
        """Send the reply to a request once the policy has answered."""
        try:
            result = await asyncio.wrap_future(cast("Future[Inference | MemoryArrays | None]", done))
            endpoint = request.get("endpoint")
            ms = 1000 * (time.monotonic() - begun)
            reply: dict[str, Any] = {"status": endpoint, "server_timing": {f"{endpoint}_ms": ms}}
            if isinstance(result, Inference):
                reply = self._chunk_reply(result, session, start)
            elif result is not None:
                reply[MEMORY] = _sound_memory(result)
            echo = {key: request[key] for key in ("session_id", "step") if request.get(key) is not None}
            await self._socket.send(packb({**reply, **echo}))
            self._previous_seconds = time.monotonic() - begun
        except ConnectionClosed:
            pass
        except Exception as exc:  # whatever a policy returns has to be packed
            await self._fail(exc)
        finally:
            session.n_pending -= 1
            session.used_at = time.monotonic()

    def _chunk_reply(self, result: Inference, session: Session, start: EpisodeStart | None) -> dict[str, Any]:
        timing = {"infer_ms": 1000 * result.infer_seconds, "queue_ms": 1000 * result.queue_seconds}
        if self._previous_seconds is not None:
            timing["prev_total_ms"] = 1000 * self._previous_seconds
        reply = {"actions": result.chunk.actions, "server_timing": timing}
        reading = None if start is None else self._service.sentences.answered(start)
        # Only to a client that begins with a `reset`: others speak openpi's words, which have no such key.
        if reading is not None and session.was_reset and reading.sentence not in self._told:
            self._told.add(reading.sentence)
            reply[READING_KEY] = reading.to_wire()
        return reply

    async def _fail(self, exc: Exception) -> None:
        """Send the error as text and close the connection."""
        if self._has_failed:
            return
        self._has_failed = True
        text = str(exc) if isinstance(exc, VlaEvalError) else f"{type(exc).__name__}: {exc}"
        if self._service.debug:
            text = "".join(traceback.format_exception(exc))
        logger.warning("connection %d: %s", self._number, text)
        try:
            await self._socket.send(text[:MAX_ERROR_CHARACTERS])
            await self._socket.close(INTERNAL_ERROR, "error")
        except ConnectionClosed:
            pass


def _memory(request: Mapping[str, Any]) -> MemoryArrays:
    problem = memory_problem(request.get(MEMORY))
    if problem is not None:
        raise RequestError(f"'{MEMORY}': {problem}.")
    return cast(MemoryArrays, request[MEMORY])


def _sound_memory(memory: MemoryArrays) -> dict[str, Any]:
    problem = memory_problem(memory)
    if problem is not None:
        raise RequestError(f"the policy's memory cannot be sent: {problem}.")
    return dict(memory)


def _read(data: str | bytes) -> dict[str, Any]:
    """Return a request, or raise `RequestError` if it is not a map in msgpack."""
    if isinstance(data, str):
        raise RequestError("expected a binary message (msgpack), found a text message.")
    try:
        request = unpackb(data)
    except CodecError as exc:
        raise RequestError(f"the request cannot be read: {exc}.") from exc
    if not isinstance(request, dict):
        raise RequestError(f"expected a map, found {shown(request)}.")
    return request
