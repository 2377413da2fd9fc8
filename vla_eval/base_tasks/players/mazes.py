"""Players of the labyrinths."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Cell, Player, first_step

LEFT, RIGHT, UP, DOWN, NONE = range(5)
MOVES = {LEFT: (0, -1), RIGHT: (0, 1), UP: (-1, 0), DOWN: (1, 0)}
CLOCKWISE = (UP, RIGHT, DOWN, LEFT)
WALL, START, GOAL = 1, 2, 3


class WallFollower(Player):
    """Keeps its right hand at the wall: the last action, which is in view, is where it looks.

    At the northern and western border the view is cut, so that the agent is not in its centre.
    """

    def act(self, observation: Any, state: Level) -> int:
        """Turn right if that is free, else straight on, else left, else back."""
        view, last = np.reshape(observation[:9], (3, 3)), int(observation[9])
        facing = CLOCKWISE.index(last) if last != NONE else 0
        row, column = _place(view, last)
        for turn in (1, 0, 3, 2):
            action = CLOCKWISE[(facing + turn) % 4]
            i, j = row + MOVES[action][0], column + MOVES[action][1]
            if 0 <= i < 3 and 0 <= j < 3 and view[i, j] != WALL:
                return action
        return CLOCKWISE[(facing + 1) % 4]


def _place(view: NDArray[Any], last: int) -> Cell:
    """Return where the agent is in its view: in the centre, unless it stands on a start at the cut border.

    The view is then filled with walls on the other side. From the cell next to such a start it can look
    alike, but not to somebody who has just walked towards the start.
    """
    if view[0, 1] == START and (view[2] == WALL).all() and last in (NONE, UP):
        return 0, 1
    if view[1, 0] == START and (view[:, 2] == WALL).all() and last in (NONE, LEFT):
        return 1, 0
    return 1, 1


class ShortestPath(Player):
    """Walks to the goal by the shortest way."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the first step of it."""
        grid = state["grid"]
        return _step(state, lambda cell: bool(grid[cell] == GOAL))


class NearestUnseen(Player):
    """Walks to the nearest cell that it has not visited."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the first step to it."""
        explored = state["explored"]
        return _step(state, lambda cell: not explored[cell])


def _cell(state: Level) -> Cell:
    row, column = (int(number) for number in state["position"])
    return row, column


def _step(state: Level, is_wanted: Callable[[Cell], bool]) -> int:
    step = first_step(state["grid"] != WALL, _cell(state), is_wanted, MOVES)
    return LEFT if step is None else step
