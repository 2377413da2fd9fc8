"""Numpad: find out by trial in which order four tiles have to be pressed, then repeat it.

Rules: https://github.com/Syrlander/numpad-gym/tree/24e04e7, after Humplik et al. 2019; written from a
description, as that repository has no licence. It ignores seeds; here they draw the sequence and the place of
the ball, which begins anywhere.
"""

from abc import abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.drawing import GOOD, HIDDEN, MARK, Cell, board_picture
from vla_eval.base_tasks.env import BaseTaskEnv, Level

SIDE, LENGTH = 3, 4  # tiles of a side, and of a sequence
N_TILES = SIDE * SIDE
NEIGHBOURS = ((0, 1), (0, -1), (1, 0), (-1, 0))
MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))  # action -> (row, column): up, right, down, left
PITCH, TILE = 20.0, 10.0  # of the continuous pad: distance of tiles, side of one
FIELD = SIDE * PITCH - 1
SPEED_UNIT = 5.0  # of the observation


class NumpadEnv(BaseTaskEnv):
    """What both pads share: the sequence, its lights and its rewards.

    A tile that is due lights up, and pays 1 if the lap has not come so far before; another one puts all
    lights out. When the lap is complete it begins again.
    """

    level_names = ("sequence", "ball")
    retries: bool
    """Whether a wrong tile can be the first of a new lap."""

    def true_state(self) -> Level:
        """Return `sequence` (4,), tile numbers row by row; where the `ball` is; `progress`, tiles pressed."""
        return {
            "sequence": self._sequence.copy(),
            "ball": np.array(self._ball),
            "progress": np.array(self._progress),
        }

    def _begin(self, seed: int | None, level: Level | None) -> NDArray[Any]:
        if level is None:
            self._sequence = self._drawn_sequence()
            self._ball = self._drawn_ball()
        else:
            self._sequence = np.array(level["sequence"], np.int64)
            self._ball = np.array(level["ball"])
        self._lights = np.zeros(N_TILES)
        self._progress, self._best, self._n_laps = 0, -1, 0
        self._begin_ball()
        return self._observation()

    def _drawn_sequence(self) -> NDArray[np.int64]:
        """Return a walk over neighbouring tiles that visits none twice."""
        while True:
            walk = [int(self.np_random.integers(N_TILES))]
            while len(walk) < LENGTH:
                row, column = divmod(walk[-1], SIDE)
                near = [(row + di, column + dj) for di, dj in NEIGHBOURS]
                tiles = [i * SIDE + j for i, j in near if 0 <= i < SIDE and 0 <= j < SIDE]
                open_tiles = [tile for tile in tiles if tile not in walk]
                if not open_tiles:
                    break
                walk.append(int(self.np_random.choice(open_tiles)))
            if len(walk) == LENGTH:
                return np.array(walk)

    def _press(self, tile: int) -> tuple[float, bool]:
        """Press a tile; return the reward, and whether the lap is complete."""
        if tile != self._sequence[self._progress]:
            self._lights[:] = 0
            self._progress = 0
            if not self.retries or tile != self._sequence[0]:
                return 0.0, False
        index = self._progress
        reward = float(index > self._best)
        self._best = max(self._best, index)
        self._lights[tile] = 1
        self._progress += 1
        return reward, self._progress == LENGTH

    def _after_lap(self) -> None:
        self._lights[:] = 0
        self._progress, self._best = 0, -1
        self._n_laps += 1

    def _is_success(self) -> bool:
        return self._n_laps > 0

    def _picture(self) -> NDArray[np.uint8]:
        place = self._tile()

        def cell(tile: int) -> Cell:
            color = GOOD if self._lights[tile] else MARK if tile == place else HIDDEN
            return Cell("o" if tile == place else "", color)

        rows = [[cell(i * SIDE + j) for j in range(SIDE)] for i in range(SIDE)]
        return board_picture(rows, [f"{self._n_laps} laps"])

    @abstractmethod
    def _drawn_ball(self) -> NDArray[Any]:
        """Draw where the ball begins."""

    @abstractmethod
    def _begin_ball(self) -> None:
        """Put it there, at rest."""

    @abstractmethod
    def _observation(self) -> NDArray[Any]:
        """Return the observation."""

    @abstractmethod
    def _tile(self) -> int | None:
        """Return the number of the tile that the ball is on."""


class DiscreteNumpadEnv(NumpadEnv):
    """The ball lies on a tile and is moved to a neighbour; at the border it presses its tile again.

    Observation (2, 3, 3) int64: lights, ball. Actions: 0 up, 1 right, 2 down, 3 left. A wrong tile counts as
    the first of a new lap, if it is that.
    """

    retries = True

    def __init__(self, *, horizon_steps: int, render_mode: str | None = None) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        self.observation_space = gym.spaces.Box(0, 1, (2, SIDE, SIDE), np.int64)
        self.action_space = gym.spaces.Discrete(len(MOVES))

    def _drawn_ball(self) -> NDArray[np.int64]:
        return self.np_random.integers(SIDE, size=2)

    def _begin_ball(self) -> None:
        self._row, self._column = (int(number) for number in self._ball)

    def _advance(self, action: Any) -> tuple[NDArray[np.int64], float, bool]:
        di, dj = MOVES[action]
        self._row = min(max(self._row + di, 0), SIDE - 1)
        self._column = min(max(self._column + dj, 0), SIDE - 1)
        reward, is_lap = self._press(self._tile())
        observation = self._observation()
        if is_lap:
            self._after_lap()
        self._ball = np.array([self._row, self._column])
        return observation, reward, False

    def _observation(self) -> NDArray[np.int64]:
        seen = np.zeros((2, SIDE, SIDE), np.int64)
        seen[0] = self._lights.reshape(SIDE, SIDE)
        seen[1, self._row, self._column] = 1
        return seen

    def _tile(self) -> int:
        return self._row * SIDE + self._column


class ContinuousNumpadEnv(NumpadEnv):
    """The ball rolls on a square field; a tile is pressed when the ball comes onto it.

    Observation (13,) float64: position (row, column) / 60, velocity / 5, nine lights. Action (2,) float64 in
    [-1, 1]: acceleration per step.
    """

    retries = False

    def __init__(self, *, horizon_steps: int, render_mode: str | None = None) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        # From rest, at one unit per step, nothing gets faster than 11 per step on a field of this size.
        high = np.array([1.0, 1.0, 2.5, 2.5, *[1.0] * N_TILES])
        low = np.array([0.0, 0.0, -2.5, -2.5, *[0.0] * N_TILES])
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float64)

    def _drawn_ball(self) -> NDArray[np.float64]:
        return self.np_random.uniform(0, FIELD, 2)

    def _begin_ball(self) -> None:
        self._velocity = np.zeros(2)
        self._last_tile: int | None = None

    def _advance(self, action: Any) -> tuple[NDArray[np.float64], float, bool]:
        self._velocity = self._velocity + action
        moved = self._ball + self._velocity
        self._ball = np.clip(moved, 0.0, FIELD)
        self._velocity[self._ball != moved] = 0.0
        tile, reward, is_lap = self._tile(), 0.0, False
        if tile is not None and tile != self._last_tile:
            reward, is_lap = self._press(tile)
        self._last_tile = tile
        observation = self._observation()
        if is_lap:
            self._after_lap()
        return observation, reward, False

    def _observation(self) -> NDArray[np.float64]:
        return np.concatenate([self._ball / (SIDE * PITCH), self._velocity / SPEED_UNIT, self._lights])

    def _tile(self) -> int | None:
        tile = (self._ball // PITCH).astype(int)
        from_centre = np.abs(self._ball - (tile + 0.5) * PITCH)
        return int(tile[0] * SIDE + tile[1]) if (from_centre < TILE / 2).all() else None
