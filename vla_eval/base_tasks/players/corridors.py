"""Players of the Passive T-Maze."""

from typing import Any

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player

ALONG, UP, DOWN = 0, 1, 3


class Oracle(Player):
    """Walks straight and turns to the goal."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the action."""
        if observation[0] < 1:
            return ALONG
        return UP if state["goal_y"] > 0 else DOWN


class TurnsUp(Player):
    """Walks straight and always turns to the same side."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the action."""
        return ALONG if observation[0] < 1 else UP
