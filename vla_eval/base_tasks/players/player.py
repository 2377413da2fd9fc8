"""What acts in: a memoryless player, an oracle."""

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any  # observations and actions, as Gymnasium has them

import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.env import Level

Cell = tuple[int, int]


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


def first_step(
    is_free: NDArray[np.bool_],
    start: Cell,
    is_wanted: Callable[[Cell], bool],
    moves: Mapping[int, tuple[int, int]],
) -> int | None:
    """Return the first action on a shortest way to a wanted cell other than the start, or None.

    Args:
        is_free: where one can walk, `(rows, columns)`.
        start: where the search begins.
        is_wanted: whether the way may end at a cell.
        moves: by action, the change of row and column; of equally short ways, the one that begins with the
            earlier action wins.
    """
    queue, first = deque([start]), {start: -1}
    while queue:
        cell = queue.popleft()
        if cell != start and is_wanted(cell):
            return first[cell]
        for action, (di, dj) in moves.items():
            near = cell[0] + di, cell[1] + dj
            is_inside = 0 <= near[0] < is_free.shape[0] and 0 <= near[1] < is_free.shape[1]
            if is_inside and near not in first and is_free[near]:
                first[near] = action if cell == start else first[cell]
                queue.append(near)
    return None
