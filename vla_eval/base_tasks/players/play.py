"""Find the player of a row; `random` is one of every row."""

import copy
import importlib
from typing import Any, Literal, cast

import gymnasium as gym
import numpy as np

from vla_eval.base_tasks.catalog import base_task
from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player
from vla_eval.errors import SpecMismatchError

Kind = Literal["random", "memoryless", "oracle"]


class RandomPlayer(Player):
    """Uniform over the action space."""

    def __init__(self, space: gym.Space[Any]) -> None:
        super().__init__({})
        self._space = copy.deepcopy(space)  # its generator is this player's alone

    def begin(self, rng: np.random.Generator) -> None:
        """Seed the space by this episode's generator."""
        self._space.seed(int(rng.integers(2**31)))

    def act(self, observation: Any, state: Level) -> Any:
        """Return a sample."""
        return self._space.sample()


def player_of(name: str, kind: Kind, space: gym.Space[Any]) -> Player:
    """Return the player of a kind for a task.

    Args:
        name: of the task.
        kind: `random`, `memoryless` or `oracle`.
        space: the environment's action space.

    Raises:
        SpecMismatchError: no good policy without memory is known for this task.
    """
    row = base_task(name)
    if kind == "random":
        return RandomPlayer(space)
    entry_point = row.oracle if kind == "oracle" else row.memoryless
    if entry_point is None:
        raise SpecMismatchError(
            f"{row.gym_id} has no memoryless player: the best policy without memory is not known, and random "
            "actions are not put in its place. Leave this task out for 'memoryless'."
        )
    module, _, attribute = entry_point.partition(":")
    return cast("Player", getattr(importlib.import_module(module), attribute)(row.kwargs))
