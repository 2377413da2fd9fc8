"""Policy servers of a few lines, each in a thread of the test."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from vla_eval.features import ACTION_NAMES, STATE_NAMES
from vla_eval.wire.codec import packb, unpackb

CHUNK_SIZE = 4
OURS: dict[str, Any] = {
    "protocol": "openpi+1",
    "name": "small",
    "weights_sha256": "ab" * 32,
    "recipe_sha256": "cd" * 32,
    "chunk_size": CHUNK_SIZE,
    "control_mode": "pd_ee_delta_pose",
    "action_dims": list(ACTION_NAMES),
    "control_hz": 20.0,
    "cameras": {},
    "state_key": "observation/state",
    "state_dims": list(STATE_NAMES["joints"]),
    "state_layouts": {"joints": list(STATE_NAMES["joints"])},
    "prompt_key": "prompt",
    "needs_every_frame": False,
    "needs_session_id": True,
    "batch_max": 1,
    "supports": ["reset", "observe", "seed", "row"],
    "versions": {"numpy": "2"},
    "n_sessions": 0,
}


@contextlib.contextmanager
def serving(handler: Callable[[ServerConnection], None], *, port: int = 0, **kwargs: Any) -> Iterator[str]:
    """Serve until the block ends; yields the address."""

    def quietly(connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            handler(connection)

    with serve(quietly, "127.0.0.1", port, compression=None, ping_interval=None, **kwargs) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


class SmallServer:
    """A server of our wire: its actions are a function of the session's seed and of the step.

    Attributes:
        metadata: its first message.
        requests: everything that it was sent, in order.
        n_connections: how many there were.
        answer: from a request to its reply, a list of replies, or none; replaced by tests of faults.
    """

    def __init__(self, **metadata: Any) -> None:
        self.metadata = {**OURS, **metadata}
        self.requests: list[dict[str, Any]] = []
        self.seeds: dict[str, int] = {}
        self.n_connections = 0
        self.answer: Callable[[dict[str, Any]], Any] = self.usual_answer

    def usual_answer(self, request: dict[str, Any]) -> dict[str, Any] | None:
        address = {key: request[key] for key in ("session_id", "step") if key in request}
        endpoint = request.get("endpoint", "infer")
        if endpoint == "reset":
            self.seeds[request["session_id"]] = request["seed"]
            return {"status": "reset", **address}
        if endpoint == "observe":
            return None
        seed = self.seeds.get(request.get("session_id", ""), 0)
        return {"actions": some_actions(seed, request.get("step", 0)), **address}

    def __call__(self, connection: ServerConnection) -> None:
        self.n_connections += 1
        connection.send(packb(self.metadata))
        for frame in connection:
            assert isinstance(frame, bytes)
            request = unpackb(frame)
            self.requests.append(request)
            reply = self.answer(request)
            for one in reply if isinstance(reply, list) else [] if reply is None else [reply]:
                connection.send(one if isinstance(one, str | bytes) else packb(one))


def some_actions(seed: int, step: int, chunk_size: int = CHUNK_SIZE) -> np.ndarray:
    """Return actions that tell episodes and steps apart."""
    generator = np.random.default_rng([seed, step])
    return generator.uniform(-1, 1, size=(chunk_size, len(ACTION_NAMES))).astype(np.float32)
