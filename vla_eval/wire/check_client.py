"""One connection to a policy server, and episodes of noise over it, for `check.py`.

This file runs with Python 3.8, numpy 1.22 and websockets 13, with files next to it: see `mikasa_vla_client`.
"""

from __future__ import annotations

import contextlib
import inspect
from dataclasses import dataclass
from typing import Any, Dict, List, Mapping, Sequence

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidURI
from websockets.sync.client import connect

from .codec import MAX_MESSAGE_BYTES, CodecError, packb, unpackb  # relative: the file is in two packages
from .keys import key_headers, key_problem
from .noise import ROWS, look_at, n_inferences, noise_image, noise_state
from .numbers import COMMITTED_ACTIONS_KEY, COMMITTED_FROZEN_KEY, GET_MEMORY, MEMORY, SET_MEMORY

HORIZON_STEPS = 60
PROMPTS, TASK = ("pick up the red cube", "touch the cube that was shown"), "RememberColor3-v0"

Message = Dict[str, Any]  # Any: whatever a message may hold
Chunks = List["np.ndarray[Any, Any]"]


class CheckFailedError(Exception):
    """A server does not keep the protocol, or cannot be reached."""


class RefusedError(Exception):
    """The server answered with a text, as it does for an error."""


@dataclass(frozen=True)
class Facts:
    """Server metadata, as far as it is needed here."""

    chunk_size: int
    n_dims: int
    cameras: Mapping[str, tuple[int, int]]  # key -> height, width
    state_key: str | None
    layouts: Mapping[str, Sequence[str]]  # name -> names of its numbers
    prompt_key: str
    needs_every_frame: bool
    batch_max: int
    supports: Sequence[str]
    joins: bool  # whether its chunks join what a request says is committed

    def observation(self, seed: int, step: int, layout: str | None = None) -> Message:
        """Return noise in the announced shapes, see `noise.py`."""
        rng = np.random.default_rng((seed, step))
        look = look_at(seed, step, self.chunk_size)
        frame: Message = {key: noise_image(rng, look, *size) for key, size in self.cameras.items()}
        if self.state_key is not None and self.layouts:
            names = self.layouts[layout or next(iter(self.layouts))]
            frame[self.state_key] = noise_state(rng, look, names)
        return {**frame, self.prompt_key: PROMPTS[seed % 2]}


class Server:
    """The server that is checked; `facts` and `alone` are filled in as they become known."""

    def __init__(self, url: str, api_key: str | None, timeout_seconds: float) -> None:
        self.url, self.timeout_seconds = url, timeout_seconds
        problem = None if api_key is None else key_problem(api_key)
        if problem is not None:
            raise self.failed(f"the API key cannot be sent: {problem}.")
        self._headers = key_headers(api_key)
        self.facts: Any = None
        self.alone: dict[int, Chunks] = {}

    def connect(self) -> Connection:
        """Open a connection and read the first message."""
        options: dict[str, Any] = {"ping_interval": None, "proxy": None}
        accepted = inspect.signature(connect).parameters  # websockets 13 has neither
        options = {name: value for name, value in options.items() if name in accepted}
        try:
            opened = contextlib.ExitStack()
            socket = opened.enter_context(
                connect(
                    self.url,
                    additional_headers=self._headers,
                    compression=None,
                    max_size=MAX_MESSAGE_BYTES,
                    open_timeout=self.timeout_seconds,
                    **options,
                )
            )
        except (OSError, ValueError, InvalidHandshake, InvalidURI, TimeoutError) as exc:
            raise self.failed(f"no connection: {exc or type(exc).__name__}. Start the server first.") from exc
        connection = Connection(self, socket, opened)
        try:
            connection.metadata = connection.receive()
        except RefusedError as exc:
            connection.close()
            raise self.failed(f"expected a map as the first message, found the text: {exc}") from exc
        except CheckFailedError as exc:
            connection.close()
            raise CheckFailedError(
                f"{exc} This was the first message, in which a server of openpi's protocol says what it is. "
                f"For another protocol, name a recipe: `mikasa-vla list` shows those that begin with remote_."
            ) from exc
        return connection

    def first_message(self) -> Message:
        """Return the server's metadata."""
        with self.connect() as connection:
            return connection.metadata

    def failed(self, message: str) -> CheckFailedError:
        """Return the error with the server's address."""
        return CheckFailedError(f"{self.url}: {message}")

    def expect(self, holds: bool, requirement: str, found: str) -> None:
        """Raise `CheckFailedError` unless a requirement is met."""
        if not holds:
            raise self.failed(f"{requirement} Found: {found}.")


class Connection:
    """One connection; replies for another session than the one asked for are kept."""

    def __init__(self, server: Server, socket: Any, opened: contextlib.ExitStack) -> None:
        self._server, self._socket, self._opened = server, socket, opened
        self._kept: dict[str, list[Message]] = {}
        self.metadata: Message = {}

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._opened.close()

    def send(self, message: Any) -> None:
        """Send a map, or bytes and text as they are."""
        with contextlib.suppress(ConnectionClosed):  # why it was closed, `receive` says
            self._socket.send(packb(message) if isinstance(message, dict) else message)

    def receive(self, session_id: str | None = None) -> Message:
        """Return the next reply, or the next one for this session."""
        kept = self._kept.get(session_id or "")
        if kept:
            return kept.pop(0)
        while True:
            reply = self._receive()
            other = reply.get("session_id")
            if session_id is None or other == session_id or not isinstance(other, str):
                return reply
            self._kept.setdefault(other, []).append(reply)

    def _receive(self) -> Message:
        try:
            data = self._socket.recv(timeout=self._server.timeout_seconds)
        except TimeoutError as exc:
            seconds = self._server.timeout_seconds
            raise self._server.failed(f"no reply within {seconds:g} s.") from exc
        except ConnectionClosed as exc:
            raise self._server.failed(f"the connection was closed without a message: {exc}.") from exc
        if isinstance(data, str):
            raise RefusedError(data)
        try:
            reply = unpackb(data)
        except CodecError as exc:
            raise self._server.failed(f"expected msgpack with arrays as openpi packs them: {exc}.") from exc
        self._server.expect(isinstance(reply, dict), "A message is a map.", type(reply).__name__)
        return dict(reply)


class Episode:
    """One episode in one session: reset, then an inference every `chunk_size` steps."""

    def __init__(self, server: Server, connection: Connection, seed: int, session_id: str = "a") -> None:
        self._server, self._facts, self._connection = server, server.facts, connection
        self._seed, self._session_id = seed, session_id
        self._next = 0
        self.chunk_size: int = self._facts.chunk_size
        self.chunks: Chunks = []

    def begin(self) -> None:
        """Reset the session."""
        facts: Message = {"task": TASK, "seed": self._seed, "run": 0, "horizon_steps": HORIZON_STEPS}
        row = {"row": ROWS[self._seed] % self._facts.batch_max} if "row" in self._facts.supports else {}
        about = {self._facts.prompt_key: PROMPTS[self._seed % 2], **facts, **row}
        self._connection.send({"endpoint": "reset", "session_id": self._session_id, **about})
        reply = self._reply()
        self._server.expect(
            reply.get("status") == "reset", "The reply to `reset` has 'status': 'reset'.", shown(reply)
        )

    def ask(self, layout: str | None = None, *, committed: Message | None = None) -> None:
        """Send the frames since the last inference, then the newest one with the request.

        `committed`: what the request says is committed.
        """
        step = self._next * self._facts.chunk_size
        named = {"session_id": self._session_id}
        if self._facts.needs_every_frame:
            for past in range(max(step - self._facts.chunk_size + 1, 0), step):
                frame = self._facts.observation(self._seed, past, layout)
                self._connection.send({**frame, **named, "step": past, "endpoint": "observe"})
        frame = self._facts.observation(self._seed, step, layout)
        request = {**frame, **(committed or {}), **named, "step": step, "endpoint": "infer"}
        self._connection.send(request)

    def answer(self) -> None:
        """Read the reply, check it, and keep its actions."""
        reply, facts, expect = self._reply(), self._facts, self._server.expect
        step = self._next * facts.chunk_size
        echo = (reply.get("session_id"), reply.get("step"))
        requirement = "A reply repeats `session_id` and `step` of its request; `observe` has no reply."
        expect(echo == (self._session_id, step), requirement, f"{echo}, expected {(self._session_id, step)}")
        expect(isinstance(reply.get("server_timing"), dict), "A reply has `server_timing`.", shown(reply))
        chunk, shape = reply.get("actions"), (facts.chunk_size, facts.n_dims)
        is_chunk = isinstance(chunk, np.ndarray) and chunk.dtype == np.float32 and chunk.shape == shape
        expect(is_chunk, f"`actions` is float32 of shape {shape}.", shown(chunk))
        expect(bool(np.isfinite(np.asarray(chunk)).all()), "Actions are finite.", "values that are not")
        self.chunks.append(np.asarray(chunk))
        self._next += 1

    def continue_from(self, other: Episode) -> None:
        """Be the other session's episode: its memory in place of this one's, and its chunks so far."""
        memory = other.remember(None).get(MEMORY)
        self._server.expect(
            isinstance(memory, dict), f"The reply to `{GET_MEMORY}` has a map.", shown(memory)
        )
        self.remember(memory)
        self._next, self.chunks = other._next, list(other.chunks)

    def remember(self, memory: Any) -> Message:
        """Replace the session's memory, or read it if that is None; return the reply."""
        endpoint = GET_MEMORY if memory is None else SET_MEMORY
        given = {} if memory is None else {MEMORY: memory}
        self._connection.send({**given, "endpoint": endpoint, "session_id": self._session_id})
        reply = self._reply()
        has_status = isinstance(reply.get("status"), str) and reply["status"] == endpoint
        requirement = f"The reply to `{endpoint}` has 'status': '{endpoint}'."
        self._server.expect(has_status, requirement, shown(reply))
        return reply

    def _reply(self) -> Message:
        try:
            return self._connection.receive(self._session_id)
        except RefusedError as exc:
            raise self._server.failed(f"a request that keeps the protocol was refused: {exc}") from exc


def committed(actions: np.ndarray[Any, Any], n_frozen: int) -> Message:
    """Return what a request says is committed: actions (N, A), and how many of them are frozen."""
    return {COMMITTED_ACTIONS_KEY: np.ascontiguousarray(actions), COMMITTED_FROZEN_KEY: n_frozen}


def run_episodes(episodes: Sequence[Episode]) -> list[Chunks]:
    """Run episodes side by side, all requests of a round before its replies; each begins a round later."""
    n_asked = n_inferences(episodes[0].chunk_size)
    for turn in range(n_asked + len(episodes) - 1):
        if turn < len(episodes):
            episodes[turn].begin()
        running = [one for k, one in enumerate(episodes) if k <= turn < k + n_asked]
        for episode in running:
            episode.ask()
        for episode in running:
            episode.answer()
    return [episode.chunks for episode in episodes]


def shown(value: Any) -> str:
    """Return a value for a message: short, and of an array type and shape."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype} of shape {value.shape}"
    if isinstance(value, dict):
        return "a map with " + (", ".join(sorted(map(str, value))) or "nothing")[:120]
    return repr(value)[:120]
