"""Passive T-Maze: a goal is shown at the start of a corridor, the turn is at its end.

Rules: https://github.com/twni2016/Memory-RL/blob/c9b8b39/envs/tmaze.py (MIT). An episode always has
length + 1 steps, so that a wasted one loses it.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.drawing import GOOD, MARK, PAPER, Cell, board_picture
from vla_eval.base_tasks.env import BaseTaskEnv, Level

MOVES = ((1, 0), (0, 1), (-1, 0), (0, -1))  # action -> (dx, dy)


class TMazeEnv(BaseTaskEnv):
    """Walk along a corridor and turn to the side that was shown at its start.

    Observation (2,) float32: at the start [0, ±1] once, later [0, 0]; in the corridor [0, 0]; at its end
    [1, y]. Actions: 0 along the corridor, 1 up, 2 back, 3 down. Reward at the last step: 1 at the goal;
    `is_dense`: -1 / length for each earlier step behind schedule.

    Args:
        length: of the corridor.
        is_dense: whether being late is punished.
    """

    level_names = ("goal_y",)

    def __init__(
        self, *, length: int, is_dense: bool, horizon_steps: int, render_mode: str | None = None
    ) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        self._length, self._is_dense = length, is_dense
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.action_space = gym.spaces.Discrete(len(MOVES))

    def true_state(self) -> Level:
        """Return `goal_y`, -1 or 1, and the `position` (2,)."""
        return {"goal_y": np.array(self._goal_y), "position": np.array([self._x, self._y])}

    def _begin(self, seed: int | None, level: Level | None) -> NDArray[np.float32]:
        if level is not None:
            self._goal_y = int(level["goal_y"])
        else:
            # The generator of the original, so that a seed is its episode.
            seed = int(self.np_random.integers(2**31)) if seed is None else seed
            self._goal_y = int(np.random.RandomState(seed).choice([-1, 1]))
        self._x = self._y = self._time = 0
        self._reward = 0.0
        return np.array([0.0, self._goal_y], np.float32)

    def _advance(self, action: Any) -> tuple[NDArray[np.float32], float, bool]:
        self._time += 1
        dx, dy = MOVES[action]
        x, y = self._x + dx, self._y + dy
        if (0 <= x <= self._length and y == 0) or (x == self._length and abs(y) == 1):
            self._x, self._y = x, y
        is_last = self._time > self._length
        if is_last:
            self._reward = float(self._x == self._length and self._y == self._goal_y)
        elif self._is_dense:
            self._reward = -1 / self._length if self._x < self._time else 0.0
        seen = [float(self._x == self._length), self._y if self._x == self._length else 0.0]
        return np.array(seen, np.float32), self._reward, is_last

    def _is_success(self) -> bool:
        return self._reward == 1.0

    def _picture(self) -> NDArray[np.uint8]:
        def cell(x: int, y: int) -> Cell:
            is_here = (x, y) == (self._x, self._y)
            is_shown = self._time == 0 and (x, y) == (self._length, self._goal_y)
            return Cell("", MARK if is_here else GOOD if is_shown else PAPER)

        outside = Cell("", (90, 92, 100))
        rows = [
            [cell(x, y) if y == 0 or x == self._length else outside for x in range(self._length + 1)]
            for y in (1, 0, -1)
        ]
        return board_picture(rows, [f"step {self._time} of {self._length + 1}"])
