"""Policies of a few lines whose chunks show what they were given, and a server around one."""

import asyncio
import contextlib
import threading
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.features import ACTION_NAMES, STATE_NAMES
from vla_eval.policies.compiled import Compilation
from vla_eval.serving.host import HostedPolicy
from vla_eval.serving.observations import observation_reader
from vla_eval.serving.server import PolicyServer, ServerOptions
from vla_eval.specs import PolicySpec
from vla_eval.tasks.interface import ANY_TASK, env_spec
from vla_eval.wire.metadata import PROTOCOL, SUPPORTS, ServerMetadata

CHUNK_SIZE = 2


class CountingPolicy:
    """Remembers how many frames an episode has had; a chunk holds seed, step and that number.

    `hold` makes a pass wait; `bad_seed` fails. A pass that fails leaves all counts as they were.
    """

    def __init__(self, *, reads: Literal["last", "every"] = "last", bad_seed: int | None = None) -> None:
        self.spec = PolicySpec(
            name="counting", reads=reads, cameras=(), states=("qpos",), chunk_size=CHUNK_SIZE
        )
        self.passes: list[list[int]] = []
        self.forgotten: list[int] = []
        self.begun, self.hold = threading.Event(), threading.Event()
        self.hold.set()
        self._bad_seed = bad_seed
        self._starts: dict[int, EpisodeStart] = {}
        self._n_frames: dict[int, int] = {}

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        for episode in episodes:
            if episode.instruction == "refuse":
                raise ValueError("no such task")
            self._starts[episode.slot], self._n_frames[episode.slot] = episode, 0

    def forget(self, slots: Sequence[int]) -> None:
        self.forgotten += slots

    def act(self, window: ObservationWindow) -> ActionChunk:
        return self.act_batch([window])[0]

    def act_batch(self, windows: Sequence[ObservationWindow]) -> list[ActionChunk]:
        starts = [self._starts[window.slot] for window in windows]
        self.passes.append([start.seed for start in starts])
        self.begun.set()
        assert self.hold.wait(10)
        if self._bad_seed in self.passes[-1]:
            raise ArithmeticError("a bad episode")
        for window in windows:
            self._n_frames[window.slot] += len(window.frames)
        return [self._chunk(start, window) for start, window in zip(starts, windows, strict=True)]

    def _chunk(self, start: EpisodeStart, window: ObservationWindow) -> ActionChunk:
        actions = np.zeros((CHUNK_SIZE, len(ACTION_NAMES)), dtype=np.float32)
        actions[:, :3] = start.seed, window.last.step, self._n_frames[window.slot]
        return ActionChunk(actions=actions)


class OneByOnePolicy:
    """The same, without `act_batch`."""

    def __init__(self) -> None:
        self.inner = CountingPolicy()
        self.spec, self.reset, self.act = self.inner.spec, self.inner.reset, self.inner.act


def host(policy: Any, *, n_rows: int = 1) -> HostedPolicy:
    env = env_spec()
    reader = observation_reader(policy.spec, env, end_effector=False)
    metadata = ServerMetadata(
        protocol=PROTOCOL,
        name="counting",
        weights_known=True,
        chunk_size=CHUNK_SIZE,
        action_dims=ACTION_NAMES,
        control_mode=env.action.control_mode,
        control_hz=env.control_hz,
        cameras=reader.cameras,
        state_key="observation/state",
        state_dims=next(iter(reader.state_layouts.values())),
        state_layouts=reader.state_layouts,
        prompt_key="prompt",
        needs_every_frame=policy.spec.reads == "every",
        needs_session_id=True,
        batch_max=n_rows,
        supports=SUPPORTS,
        versions={},
    )
    return HostedPolicy(policy=policy, metadata=metadata, reader=reader, task=ANY_TASK, env=env)


def frame(**fields: Any) -> dict[str, Any]:
    """Return a request with the 9 joint positions."""
    n_joints = (len(STATE_NAMES["joints"]) - 7) // 2
    return {"observation/state": np.zeros(n_joints, dtype=np.float32), "prompt": "remember", **fields}


class Running:
    """A server in a thread."""

    def __init__(self, hosted: HostedPolicy, options: ServerOptions) -> None:
        self._ready, self.port = threading.Event(), 0
        self._thread = threading.Thread(target=asyncio.run, args=(self._main(hosted, options),))
        self._thread.start()
        assert self._ready.wait(10)

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def stop(self) -> None:
        """Ask it to stop, as a signal does."""
        with contextlib.suppress(RuntimeError):  # it has ended before
            self._loop.call_soon_threadsafe(self._stop.set)

    def wait(self) -> None:
        self._thread.join(15)
        assert not self._thread.is_alive()

    async def _main(self, hosted: HostedPolicy, options: ServerOptions) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        await PolicyServer(hosted, options).run(self._stop, self._note)

    def _note(self, port: int, _compiled: Compilation | None) -> None:
        self.port = port
        self._ready.set()


@contextlib.contextmanager
def serving(policy: Any, *, n_rows: int = 1, **options: Any) -> Iterator[Running]:
    server = Running(host(policy, n_rows=n_rows), ServerOptions(**{"port": 0, **options}))
    try:
        yield server
    finally:
        server.stop()
        server.wait()
