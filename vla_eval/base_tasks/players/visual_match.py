"""Players of Passive Visual Match: both gather apples; one knows the colour."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Cell, Player, first_step
from vla_eval.base_tasks.visual_match import APPLE, MOVES, PADS, REACH, WALL

SIDE = 2 * REACH + 1
ORCHARD, DOORS = 1, 2
SEEN_WALL, SEEN_EMPTY = (25, 25, 25), (204, 204, 204)
NORTH = 0


class Oracle(Player):
    """Walks to the nearest apple, in the end to the right pad."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the first step of the shortest way."""
        wanted = (str(state["target"]),) if int(state["phase"]) == DOORS else (APPLE,)
        board = np.where(np.isin(state["board"], [p for p in PADS if p not in wanted]), WALL, state["board"])
        row, column = (int(number) for number in state["position"])
        return _step(board, (row, column), lambda cell: bool(board[cell] in wanted))


class NearestInView(Player):
    """Walks to the nearest apple or pad in view; without one, out of the niche or about."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the first step."""
        view = np.reshape(observation, (3, SIDE, SIDE)).transpose(1, 2, 0)
        is_wall, is_empty = ((view == color).all(axis=-1) for color in (SEEN_WALL, SEEN_EMPTY))
        is_wanted = ~is_wall & ~is_empty
        is_wanted[REACH, REACH] = False
        if is_wanted.any():
            board = np.where(is_wall, WALL, " ")
            return _step(board, (REACH, REACH), lambda cell: bool(is_wanted[cell]))
        west, east = np.flatnonzero(is_wall[REACH, :REACH]), np.flatnonzero(is_wall[REACH, REACH + 1 :])
        if len(west) and len(east):  # only before the pads are there walls this close on both sides
            return NORTH
        free = [a for a, (di, dj) in enumerate(MOVES) if not is_wall[REACH + di, REACH + dj]]
        return int(self.rng.choice(free)) if free else NORTH


def _step(board: NDArray[Any], start: Cell, is_wanted: Callable[[Cell], bool]) -> int:
    """Return the first action on a shortest way to a wanted cell; north if there is none."""
    step = first_step(board != WALL, start, is_wanted, dict(enumerate(MOVES)))
    return NORTH if step is None else step
