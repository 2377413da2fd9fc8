"""A server of the plugin in a thread of this process; the plugin is not installed."""

import contextlib
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "plugins" / "mikasa_vla_client"))

import mikasa_vla_client as client  # after the line above

MEMORY_SPEC = client.PolicySpec(
    name="sums", chunk_size=4, cameras=("base_camera",), state="joints", needs_every_frame=True
)
HOLDABLE_SPEC = replace(MEMORY_SPEC, has_memory=True)
PLAIN_SPEC = client.PolicySpec(name="plain", chunk_size=2, state="eef")


class Sums:
    """Adds up the brightness of all frames of an episode, from a start that its seed draws."""

    def reset(self, session: Any, episode: Any) -> None:
        session.memory = np.random.default_rng(episode.seed).normal()

    def observe(self, session: Any, observation: Any) -> None:
        session.memory += float(observation["observation/image"].mean())

    def infer(self, session: Any, observation: Any) -> Any:
        self.observe(session, observation)
        return np.full((4, 7), np.sin(session.memory))


class HeldSums(Sums):
    """The same with a memory that can be read and replaced."""

    def get_memory(self, session: Any) -> Any:
        return {"sum": np.array([session.memory])}

    def set_memory(self, session: Any, memory: Any) -> None:
        if set(memory) != {"sum"} or memory["sum"].shape != (1,):
            raise ValueError(f"expected 'sum' of shape (1,), found {', '.join(memory) or 'nothing'}")
        session.memory = float(memory["sum"][0])


class MixedSums(Sums):
    """The same with one memory for all."""

    def __init__(self) -> None:
        self.memory = 0.0

    def reset(self, session: Any, episode: Any) -> None:
        super().reset(self, episode)

    def observe(self, session: Any, observation: Any) -> None:
        super().observe(self, observation)

    def infer(self, session: Any, observation: Any) -> Any:
        return super().infer(self, observation)


@contextlib.contextmanager
def served(policy: Any, spec: Any = MEMORY_SPEC, **options: Any) -> Iterator[str]:
    """Serve in a thread; yield the address."""
    server = client.PolicyServer(policy, spec, port=0, **options)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"ws://127.0.0.1:{server.port}"
    finally:
        server.close()
        thread.join()
