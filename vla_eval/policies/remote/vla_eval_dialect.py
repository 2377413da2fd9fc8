"""The words of the model servers of allenai's vla-evaluation-harness: every message in an envelope.

A session is a connection. The client greets first. The start of an episode has no answer, unless it fails.

Source (facts; the code is not used): the package vla-eval 0.8.0, `vla_eval/protocol/messages.py`,
`vla_eval/model_servers/serve.py`, `vla_eval/types.py`;
https://github.com/allenai/vla-evaluation-harness/tree/e1ee9ad
"""

import time
from collections.abc import Mapping
from typing import Any  # Any: a message may hold anything

from vla_eval.core import EpisodeStart, MemoryArrays
from vla_eval.errors import RemoteReplyError
from vla_eval.policies.remote.settings import RemoteSettings
from vla_eval.strict.json_text import shown
from vla_eval.wire.connection import MAX_SHOWN_ERROR, Connection
from vla_eval.wire.metadata import ServerMetadata

PROTOCOL_VERSION = 1
CLIENT_VERSION = "0.8.0"  # of the package whose protocol this is
HELLO, OBSERVATION, ACTION, ERROR = "hello", "observation", "action", "error"
EPISODE_START, EPISODE_END = "episode_start", "episode_end"


class VlaEvalClient:
    """A session on such a server."""

    shares_connection = False

    def __init__(self, connection: Connection, settings: RemoteSettings) -> None:
        """Greet the server, which has to greet back in this version."""
        self._connection = connection
        self._cameras = {camera.key for camera in (settings.cameras or {}).values()}
        self._n_sent = 0
        self._in_episode = False
        try:
            self._send(HELLO, {"harness_version": CLIENT_VERSION, "protocol_version": PROTOCOL_VERSION})
            said = self._receive(HELLO)
            version = said.get("protocol_version")
            if not (isinstance(version, int) and version == PROTOCOL_VERSION):
                raise self._connection.refuse(
                    f"expected version {PROTOCOL_VERSION} of the protocol of vla-eval, found {shown(version)}"
                )
            name = said.get("model_server")
            self.metadata = ServerMetadata(name=name if isinstance(name, str) and name else None, other=said)
        except BaseException:
            connection.close()
            raise

    def ask_reset(self, session: str, start: EpisodeStart) -> None:
        """End the former episode and begin another; the server does not answer."""
        if self._in_episode:
            self._send(EPISODE_END, {})
        self._send(EPISODE_START, {"task": {"name": start.task, "seed": start.seed}})
        self._in_episode = True

    def take_reset(self, session: str) -> None:
        """Wait for nothing: an error of the start arrives in place of the first actions."""

    def observe(self, session: str, request: Mapping[str, Any], *, step: int) -> None:
        """Refuse: these servers answer every frame."""
        raise RemoteReplyError(f"{self._connection.url}: this server takes no frames between inferences.")

    def ask_infer(self, session: str, request: Mapping[str, Any], *, step: int) -> None:
        """Send a frame; its images lie in a map of their own."""
        images = {key: value for key, value in request.items() if key in self._cameras}
        others = {key: value for key, value in request.items() if key not in self._cameras}
        self._send(OBSERVATION, {"images": images, **others})

    def take_infer(self, session: str) -> Any:
        """Return the actions of the answer, unchecked; an error is raised in their place."""
        payload = self._receive(ACTION)
        if "actions" not in payload:
            raise self._connection.refuse(f"expected 'actions', found {shown(sorted(payload))}")
        return payload["actions"]

    def take_reading(self, session: str) -> Any:
        """Return None: these servers say nothing of sentences."""

    def ask_memory(self, session: str, memory: MemoryArrays | None) -> Any:
        """Refuse: these servers have no such message."""
        raise RemoteReplyError(f"{self._connection.url}: this server has no messages for a memory.")

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _send(self, kind: str, payload: Mapping[str, Any]) -> None:
        self._n_sent += 1
        self._connection.send(
            {"type": kind, "payload": dict(payload), "seq": self._n_sent, "timestamp": time.time()}
        )

    def _receive(self, kind: str) -> dict[str, Any]:
        """Return the payload of the answer to what was sent last."""
        message = self._connection.receive()
        payload = message.get("payload") if isinstance(message, dict) else None
        if not isinstance(message, dict) or not isinstance(payload, dict):
            raise self._connection.refuse(f"expected a message of vla-eval, found {shown(message)}")
        found, seq = str(message.get("type")), message.get("seq")
        if found == ERROR:
            self._connection.close()
            error = str(payload.get("error", payload))
            raise RemoteReplyError(
                f"{self._connection.url}: the server replied with an error: {error[:MAX_SHOWN_ERROR]}"
            )
        if found != kind or not (isinstance(seq, int) and seq == self._n_sent):
            raise self._connection.refuse(
                f"expected '{kind}' for message {self._n_sent}, found {shown(found)} for {shown(seq)}"
            )
        return payload
