"""Players of Mortar Mayhem and Mystery Path."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player

NONE, BACK, ON = 0, 1, 2  # left or up, right or down
TILE_PX, ARENA_PX, PATH_TILE_PX = 14, 7, 12
HALF_STEP_PX = 1


class MortarOracle(Player):
    """Walks to the middle of the tile that is due."""

    def act(self, observation: Any, state: Level) -> NDArray[np.int64]:
        """Return the action."""
        return _towards(state["centre"], ARENA_PX + TILE_PX // 2 + TILE_PX * state["goal"])


class AnyTile(Player):
    """Walks about: which command is due, and where it leads, is not in view."""

    def act(self, observation: Any, state: Level) -> NDArray[np.int64]:
        """Return an action."""
        return self.rng.integers(3, size=2)


class PathOracle(Player):
    """Follows the path through the middle of its tiles."""

    def begin(self, rng: np.random.Generator) -> None:
        """Start at its beginning."""
        super().begin(rng)
        self._n_reached = 0

    def act(self, observation: Any, state: Level) -> NDArray[np.int64]:
        """Return the action."""
        path, centre = state["path"], state["centre"]
        goal = PATH_TILE_PX * path[self._n_reached] + PATH_TILE_PX // 2
        if np.abs(goal - centre).max() <= HALF_STEP_PX and self._n_reached + 1 < len(path):
            self._n_reached += 1
            goal = PATH_TILE_PX * path[self._n_reached] + PATH_TILE_PX // 2
        return _towards(centre, goal)


def _towards(centre: NDArray[np.int64], goal: NDArray[np.int64]) -> NDArray[np.int64]:
    error = goal - centre
    return np.where(np.abs(error) <= HALF_STEP_PX, NONE, np.where(error < 0, BACK, ON))
