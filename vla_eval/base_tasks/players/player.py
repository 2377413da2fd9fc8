"""What acts in: a memoryless player, an oracle."""

from collections.abc import Mapping
from typing import Any  # observations and actions, as Gymnasium has them

import numpy as np

from vla_eval.base_tasks.env import Level


class Player:
    """Acts in one episode after another; everything random comes from the episode's generator.

    Attributes:
        arguments: those of the row, which say what level it is.
        rng: of the episode.
    """

    def __init__(self, arguments: Mapping[str, Any]) -> None:
        self.arguments = arguments
        self.rng = np.random.default_rng(0)

    def begin(self, rng: np.random.Generator) -> None:
        """Forget the last episode."""
        self.rng = rng

    def act(self, observation: Any, state: Level) -> Any:
        """Return an action.

        Args:
            observation: as the environment returned it.
            state: `true_state()` at this step; empty for a memoryless player.
        """
        raise NotImplementedError
