"""Players of Memory Length."""

from typing import Any

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player


class Oracle(Player):
    """Names the bit that is asked for; earlier actions have no effect."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the bit."""
        return int(state["context"][state["query"]])


class Coin(Player):
    """Cannot know the bit when it is asked for."""

    def act(self, observation: Any, state: Level) -> int:
        """Return 0 or 1."""
        return int(self.rng.integers(2))
