"""A policy to measure rendering with: it reads both cameras and acts at random, so all cost is elsewhere."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any  # arguments of an adapter

import numpy as np

from vla_eval.core import ActionChunk, EpisodeStart, ObservationWindow
from vla_eval.policies.context import PolicyContext
from vla_eval.seeding import Stream, generator
from vla_eval.specs import PolicySpec

CAMERAS = ("base_camera", "hand_camera")


class LookingPolicy:
    """Reads the last frame of these cameras, and returns a chunk of random actions."""

    def __init__(self, chunk_size: int, cameras: tuple[str, ...]) -> None:
        self.spec = PolicySpec(name="looker", reads="last", cameras=cameras, states=(), chunk_size=chunk_size)
        self._rng = np.random.default_rng(0)

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Draw from the episode's own generator."""
        self._rng = generator(episodes[0].seed, Stream.POLICY)

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return a chunk of random actions."""
        drawn = self._rng.uniform(-1, 1, (self.spec.chunk_size, 7))
        return ActionChunk(actions=drawn.astype(np.float32))


def make_looking(context: PolicyContext) -> LookingPolicy:
    """Make the policy with chunks of as many actions as are executed; an adapter."""
    return LookingPolicy(context.chunking.n_action_steps, CAMERAS)


def write_recipe(path: Path, make: Callable[..., object], **args: Any) -> str:
    """Write the recipe of a policy that is made for measuring, by its adapter; return its path."""
    adapter = f"{make.__module__}:{make.__name__}"
    recipe = {"version": 1, "description": "of a bench", "adapter": adapter, "args": args}
    path.write_text(json.dumps(recipe))  # JSON is YAML
    return str(path)
