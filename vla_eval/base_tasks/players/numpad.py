"""A player of both numpads that knows the sequence."""

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.numpad import MOVES, PITCH, SIDE
from vla_eval.base_tasks.players.player import Player


class DiscreteOracle(Player):
    """Walks to the next tile of the sequence over tiles that do no harm."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the first step of the shortest way to the tile that is due.

        Within a lap that is a neighbour, as the sequence walks over neighbours.
        """
        due = int(state["sequence"][int(state["progress"])])
        start = int(state["ball"][0]), int(state["ball"][1])
        queue, first = deque([start]), {start: -1}
        while queue:
            row, column = queue.popleft()
            for action, (di, dj) in enumerate(MOVES):
                near = min(max(row + di, 0), SIDE - 1), min(max(column + dj, 0), SIDE - 1)
                step = action if (row, column) == start else first[row, column]
                if near[0] * SIDE + near[1] == due:
                    return step
                if near not in first:
                    first[near] = step
                    queue.append(near)
        raise AssertionError("every tile can be reached")


class ContinuousOracle(Player):
    """Steers the ball to the centre of the next tile and brakes on the way."""

    def act(self, observation: Any, state: Level) -> NDArray[np.float64]:
        """Return the acceleration."""
        due = int(state["sequence"][int(state["progress"])])
        goal = (np.array(divmod(due, SIDE)) + 0.5) * PITCH
        velocity = np.asarray(observation[2:4]) * 5.0
        error = goal - state["ball"]
        wanted = np.sign(error) * np.minimum(np.abs(error), np.sqrt(np.abs(error) * 1.2))
        acceleration: NDArray[np.float64] = np.clip(wanted - velocity, -1.0, 1.0)
        return acceleration
