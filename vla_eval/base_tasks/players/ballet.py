"""Players of Ballet. A straight walk of three steps from the centre reaches each dancer."""

from typing import Any

import numpy as np

from vla_eval.base_tasks.ballet import CENTRE, MOVES, PLACES
from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player

TILE_PX, REACH = 9, 3


class Oracle(Player):
    """Walks to the dancer that is meant."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the direction."""
        place = state["dancers"][int(state["target"])][0]
        return _towards(PLACES[int(place)])


class AnyDancer(Player):
    """Walks to a dancer that is in view, the first in reading order."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the direction of a dancer: three, two or one steps away in a straight line."""
        image = observation["image"]
        for reach in (1, 2, REACH):
            for action, (di, dj) in enumerate(MOVES):
                row, column = CENTRE + reach * di, CENTRE + reach * dj
                tile = image[row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX]
                grey = (tile == tile[..., :1]).all()
                if tile.any() and not grey:
                    return action
        return 0


def _towards(place: tuple[int, int]) -> int:
    move = tuple(int(np.sign(number - CENTRE)) for number in place)
    return MOVES.index(move)
