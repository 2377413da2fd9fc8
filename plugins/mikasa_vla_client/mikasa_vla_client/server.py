"""Serve a policy over a WebSocket, one session per episode that runs at the other end.

The protocol is openpi's, with sessions: https://github.com/Physical-Intelligence/openpi (`openpi_client`).
Knows nothing of simulators and of `vla_eval`.
"""

from __future__ import annotations

import inspect
import logging
import threading
import time
import traceback
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Callable, Mapping

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection
from websockets.sync.server import serve as listen

from mikasa_vla_client.codec import MAX_MESSAGE_BYTES, CodecError, packb, unpackb
from mikasa_vla_client.keys import HEADER, explanation, key_problem, refused
from mikasa_vla_client.numbers import GET_MEMORY, MEMORY, SET_MEMORY
from mikasa_vla_client.spec import PROMPT_KEY, PolicySpec, SpecError

logger = logging.getLogger(__name__)
# websockets 13 logs a traceback for every health check; errors of policies go to the logger above.
_of_websockets = logging.getLogger(f"{__name__}.websockets")
_of_websockets.setLevel(logging.CRITICAL)

MAX_SESSIONS = 1024  # of one connection
ENDPOINTS = ("infer", "reset", "observe", GET_MEMORY, SET_MEMORY)
EPISODE_FACTS = {"seed": int, "task": str, "run": int, "horizon_steps": int}
NO_OBSERVATION = {"endpoint", "session_id", "episode_id", "step", "row", *EPISODE_FACTS}
CLOSE_GOING_AWAY, CLOSE_ERROR = 1001, 1011


@dataclass(frozen=True)
class Episode:
    """What is known when an episode begins.

    Attributes:
        prompt: the language instruction.
        seed: draw random numbers from a generator that is seeded with it.
        task: task id, or None if the client does not say.
        run: which of several independent runs this is.
        horizon_steps: the episode ends after so many control steps, or None.
    """

    prompt: str
    seed: int = 0
    task: str | None = None
    run: int = 0
    horizon_steps: int | None = None


class Session:
    """One episode after another of one simulator.

    Attributes:
        id: the client's name for it; `""` for a client that has one session per connection.
        episode: the episode that is running.
        memory: the policy's own. None when an episode begins; dropped when the connection ends.
    """

    def __init__(self, id: str, episode: Episode) -> None:
        """Begin the first episode."""
        self.id = id
        self.episode = episode
        self.memory: Any = None


class RequestError(ValueError):
    """A message of the client is refused."""


class PolicyServer:
    """Listens from the start; `serve_forever` answers until `close` is called in another thread."""

    def __init__(
        self,
        policy: Any,
        spec: PolicySpec,
        *,
        host: str = "127.0.0.1",
        port: int = 8000,
        api_key: str | None = None,
        debug: bool = False,
    ) -> None:
        """See `serve`."""
        is_function = callable(policy) and not hasattr(policy, "infer")
        self._policy: Any = _Function(policy) if is_function else policy
        needed = ["reset", "infer", *(["observe"] if spec.needs_every_frame else [])]
        for name in needed + (["get_memory", "set_memory"] if spec.has_memory else []):
            if not callable(getattr(self._policy, name, None)):
                raise SpecError(
                    f"policy '{spec.name}' has no method {name}: expected a function, or an object with "
                    f"reset(session, episode), infer(session, observation), if needs_every_frame is True "
                    f"observe(session, observation), and if has_memory is True get_memory(session) and "
                    f"set_memory(session, memory)."
                )
        problem = None if api_key is None else key_problem(api_key)
        if problem is not None:
            raise SpecError(f"api_key: {problem}.")
        self._spec, self._api_key, self._debug = spec, api_key, debug
        self._metadata = spec.metadata()
        # It is unknown whether the policy may run in two threads.
        self._one_at_a_time = threading.Lock()
        self._sessions: dict[ServerConnection, dict[str, Session]] = {}
        options: dict[str, Any] = {
            "compression": None,
            "max_size": MAX_MESSAGE_BYTES,
            "logger": _of_websockets,
        }
        # A policy that computes for a long time answers no ping. Before websockets 15 there are none.
        if "ping_interval" in inspect.signature(listen).parameters:
            options["ping_interval"] = None
        self._server = listen(self._answer, host, port, process_request=self._check_request, **options)
        self.port: int = self._server.socket.getsockname()[1]

    def serve_forever(self) -> None:
        """Answer clients, each in a thread of its own."""
        self._server.serve_forever()

    def close(self) -> None:
        """Stop listening and end every connection."""
        self._server.shutdown()
        for connection in list(self._sessions):
            connection.close(CLOSE_GOING_AWAY, "the server stops")

    def _check_request(self, connection: ServerConnection, request: Any) -> Any:
        """Answer what needs no WebSocket, and refuse who has no key."""
        if request.path == "/healthz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        status = refused(request.headers.get_all(HEADER), self._api_key)
        return None if status is None else connection.respond(status, explanation(status))

    def _answer(self, connection: ServerConnection) -> None:
        """Answer one client until it goes, or until one of its messages is refused."""
        n_sessions = sum(len(sessions) for sessions in list(self._sessions.values()))
        sessions = self._sessions[connection] = {}
        try:
            connection.send(packb({**self._metadata, "n_sessions": n_sessions}))
            total_ms = None
            for message in connection:
                began = time.perf_counter()
                reply = self._reply(message, sessions)
                if reply is not None:
                    reply["server_timing"]["prev_total_ms"] = total_ms
                    connection.send(packb(reply))
                total_ms = _ms_since(began)
        except ConnectionClosed:
            pass  # the client has gone
        except Exception as exc:
            known = isinstance(exc, (RequestError, CodecError))
            if not known:
                logger.exception("policy '%s' failed", self._spec.name)
            text = str(exc) if known else f"policy '{self._spec.name}' failed: {type(exc).__name__}: {exc}"
            _refuse(connection, traceback.format_exc() if self._debug else text)
        finally:
            del self._sessions[connection]

    def _reply(self, message: Any, sessions: dict[str, Session]) -> dict[str, Any] | None:
        """Return the reply to a message; None for a frame that is only observed."""
        request = unpackb(message) if isinstance(message, bytes) else None
        if not isinstance(request, dict):
            raise RequestError("expected a binary message that holds a map, as openpi's client sends it.")
        endpoint, session_id = request.get("endpoint", "infer"), request.get("session_id", "")
        if endpoint not in ENDPOINTS:
            raise RequestError(f"there is no endpoint {endpoint!r:.80} (known: {', '.join(ENDPOINTS)}).")
        if not isinstance(session_id, str):
            raise RequestError(f"session_id: expected a text, found {session_id!r:.80}.")
        step = request.get("step", 0)
        if not isinstance(step, (int, np.integer)) or isinstance(step, bool):
            raise RequestError(f"step: expected a whole number, found {step!r:.80}.")
        asked = time.perf_counter()
        with self._one_at_a_time:
            reply: dict[str, Any] = {"server_timing": {"queue_ms": _ms_since(asked)}}
            began = time.perf_counter()
            if endpoint in (GET_MEMORY, SET_MEMORY):
                reply.update(self._memory(endpoint, sessions.get(session_id), request))
            elif endpoint == "reset" or session_id not in sessions:
                self._begin(session_id, request, sessions)
            if endpoint == "reset":
                reply["status"] = "reset"
            elif endpoint in ("infer", "observe"):
                answer = self._ask(endpoint, sessions[session_id], request)
                if endpoint == "observe":
                    return None
                reply["actions"] = answer
            reply["server_timing"]["infer_ms"] = _ms_since(began)
        reply.update({key: request[key] for key in ("session_id", "step") if key in request})
        return reply

    def _begin(self, session_id: str, request: Mapping[str, Any], sessions: dict[str, Session]) -> None:
        """Begin an episode in a session and forget all else of it."""
        prompt = request.get(PROMPT_KEY)
        if not isinstance(prompt, str) or not prompt:
            raise RequestError(
                f"'{PROMPT_KEY}': an episode begins with an instruction, found {prompt!r:.80}."
            )
        if session_id not in sessions and len(sessions) >= MAX_SESSIONS:
            raise RequestError(f"more than {MAX_SESSIONS} sessions on one connection.")
        facts = {key: request[key] for key in EPISODE_FACTS if request.get(key) is not None}
        for key, value in facts.items():
            if type(value) is not EPISODE_FACTS[key]:
                raise RequestError(f"{key}: expected {EPISODE_FACTS[key].__name__}, found {value!r:.80}.")
        session = sessions[session_id] = Session(session_id, Episode(prompt=prompt, **facts))
        self._policy.reset(session, session.episode)

    def _memory(self, endpoint: str, session: Session | None, request: Mapping[str, Any]) -> dict[str, Any]:
        """Read or replace the memory of a session; return what the reply says."""
        if not self._spec.has_memory:
            raise RequestError(f"'{endpoint}': policy '{self._spec.name}' has no memory that can be read.")
        if session is None:
            raise RequestError(f"'{endpoint}' without an episode. Send 'reset' first.")
        if endpoint == GET_MEMORY:
            return {"status": endpoint, MEMORY: self._spec.check_memory(self._policy.get_memory(session))}
        try:
            self._policy.set_memory(session, self._spec.check_memory(request.get(MEMORY)))
        except ValueError as exc:
            raise RequestError(str(exc)) from exc
        return {"status": endpoint}

    def _ask(self, endpoint: str, session: Session, request: Mapping[str, Any]) -> Any:
        """Give the policy a frame; return its actions if they were asked for."""
        observation = {PROMPT_KEY: session.episode.prompt}
        observation.update({key: value for key, value in request.items() if key not in NO_OBSERVATION})
        try:
            self._spec.check_observation(observation)
        except ValueError as exc:
            raise RequestError(str(exc)) from exc
        if endpoint == "observe":
            if self._spec.needs_every_frame:
                self._policy.observe(session, observation)
            return None
        return self._spec.check_actions(self._policy.infer(session, observation))


class _Function:
    """A policy without memory: actions from the observation alone."""

    def __init__(self, function: Callable[[Mapping[str, Any]], Any]) -> None:
        """Keep the function."""
        self._function = function

    def reset(self, session: Session, episode: Episode) -> None:
        """Nothing to forget."""

    def infer(self, session: Session, observation: Mapping[str, Any]) -> Any:
        """Call the function."""
        return self._function(observation)


def serve(
    policy: Any,
    spec: PolicySpec,
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    api_key: str | None = None,
    debug: bool = False,
) -> None:
    """Serve a policy until Ctrl-C.

    Args:
        policy: an object with `reset(session, episode)` and `infer(session, observation)`, which returns
            (chunk_size, number of action_dims) numbers; with `needs_every_frame` also
            `observe(session, observation)`, called for each frame between two inferences. What the policy
            remembers of an episode, it keeps in `session.memory`. Or a function: observation -> actions.
            It is never called in two threads at once. With `has_memory`, also `get_memory(session)`, a
            dict of arrays that is all that is kept of the episode, and `set_memory(session, memory)`; a
            ValueError refuses a memory.
        spec: what it reads and returns. Observations and actions are checked against it.
        host: the address to listen on; other machines reach only another one than the default.
        port: 0 for any free one.
        api_key: if given, clients have to send the header `Authorization: Api-Key KEY`.
        debug: send a traceback to the client if the policy fails.

    Raises:
        SpecError: the policy has not the methods that the spec asks for, or a key cannot be sent.
        OSError: the port is in use.
    """
    server = PolicyServer(policy, spec, host=host, port=port, api_key=api_key, debug=debug)
    logger.info("policy '%s' at ws://%s:%d", spec.name, host, server.port)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    finally:
        server.close()


def _refuse(connection: ServerConnection, text: str) -> None:
    try:
        connection.send(text)
        connection.close(CLOSE_ERROR)
    except ConnectionClosed:
        pass  # the client has gone, too


def _ms_since(began: float) -> float:
    return 1000 * (time.perf_counter() - began)
