"""Passive Visual Match: see a colour, gather apples for a while, then find the colour again.

Rules: https://github.com/twni2016/Memory-RL/tree/c9b8b39/envs/key_to_door (Apache-2.0), after Hung et al.
2019, "Optimizing agent behavior over long time scales by transporting value". Written again, as pycolab does
not run on today's Python. There, a seed is ignored, and colours are tied to places for the life of an
environment object; here both are drawn per episode.
"""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.drawing import enlarged
from vla_eval.base_tasks.env import BaseTaskEnv, Level

PHASE_STEPS = (15, 30, 15)
REACH = 2  # the agent sees so many cells to each side
N_APPLES, APPLE_BACK_AFTER_STEPS = 10, 20
MATCH_REWARD = 10.0
MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))  # action -> (row, column): north, south, west, east
WALL, AGENT, APPLE, EMPTY = "#", "+", "a", " "
PADS = ("b", "c", "e")
GREYS_AND_MORE = {WALL: (25, 25, 25), EMPTY: (204, 204, 204), AGENT: (228, 148, 109), APPLE: (140, 178, 0)}
PAD_COLORS = ((255, 0, 0), (0, 255, 0), (0, 0, 255))

_BLANK, _WALLS, _HALL = "           ", "###########", "#         #"
_SEEN = (_BLANK, "    ###    ", "    #+#    ", "    ###    ", _BLANK, _BLANK, _BLANK)
_AROUND = ((1, 4), (1, 5), (1, 6), (2, 4), (2, 6), (3, 4), (3, 5), (3, 6))
"""Where the colour can be in the first phase: the agent cannot move there."""
_ORCHARD = (_WALLS, *[_HALL] * 4, "#    +    #", _WALLS)
_TREES = tuple(
    (row, column)
    for row in range(1, 6)
    for column in (range(1, 10, 2) if row % 2 else range(2, 9, 2))
    if (row, column) != (5, 5)
)
_DOORS = (_WALLS, "# b  c  e #", _HALL, _HALL, "####   ####", "   # + #   ", "   #####   ")


class VisualMatchEnv(BaseTaskEnv):
    """See a colour, gather apples, step onto the pad of that colour.

    Observation (75,) uint8: the (3, 5, 5) colours around the agent, flattened. Actions: north, south, west,
    east. Reward: 1 for an apple, which is back 21 steps later; 10 for the right pad, if it is the first one
    stepped on. An episode has 15 + 30 + 15 steps.
    """

    level_names = ("maps", "target", "colors")

    def __init__(self, *, horizon_steps: int, render_mode: str | None = None) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        side = 2 * REACH + 1
        self.observation_space = gym.spaces.Box(0, 255, (3 * side * side,), np.uint8)
        self.action_space = gym.spaces.Discrete(len(MOVES))

    def true_state(self) -> Level:
        """Return `maps` (3, 7, 11), a character a cell; `target` and `colors` of the pads; what is now."""
        return {
            "maps": self._maps.copy(),
            "target": np.array(self._target),
            "colors": np.array(self._colors, np.uint8),
            "phase": np.array(self._phase),
            "board": self._board.copy(),
            "position": np.array(self._agent),
        }

    def _begin(self, seed: int | None, level: Level | None) -> NDArray[np.uint8]:
        if level is None:
            self._draw()
        else:
            self._maps = np.array(level["maps"], "<U1")
            self._target = str(level["target"])
            self._colors = [tuple(map(int, row)) for row in level["colors"]]
        self._time, self._won = 0, False
        self._begin_phase(0)
        return self._observation()

    def _draw(self) -> None:
        self._target = PADS[int(self.np_random.integers(len(PADS)))]
        self._colors = [PAD_COLORS[int(index)] for index in self.np_random.permutation(len(PAD_COLORS))]
        self._maps = np.array([[list(row) for row in rows] for rows in (_SEEN, _ORCHARD, _DOORS)])
        self._maps[0][_AROUND[int(self.np_random.integers(len(_AROUND)))]] = self._target
        for index in self.np_random.permutation(len(_TREES))[:N_APPLES]:
            self._maps[1][_TREES[int(index)]] = APPLE

    def _begin_phase(self, phase: int) -> None:
        self._phase, self._phase_step = phase, 0
        self._board = self._maps[phase].copy()
        row, column = (int(number) for number in np.argwhere(self._board == AGENT)[0])
        self._agent = (row, column)
        self._board[self._agent] = EMPTY
        self._picked: dict[tuple[int, int], int] = {}

    def _advance(self, action: Any) -> tuple[NDArray[np.uint8], float, bool]:
        self._phase_step += 1
        reward = self._move(MOVES[action])
        if self._phase_step < PHASE_STEPS[self._phase]:
            return self._observation(), reward, False
        is_over = self._phase == len(PHASE_STEPS) - 1
        if not is_over:
            self._begin_phase(self._phase + 1)
        return self._observation(), reward, is_over

    def _move(self, move: tuple[int, int]) -> float:
        row, column = self._agent[0] + move[0], self._agent[1] + move[1]
        if self._phase > 0 and self._board[row, column] != WALL:
            self._agent = (row, column)
        found, reward = str(self._board[self._agent]), 0.0
        if found == APPLE:
            reward = 1.0
            self._board[self._agent] = EMPTY
            self._picked[self._agent] = self._phase_step
        elif found in PADS and self._phase == len(PHASE_STEPS) - 1:
            self._won = found == self._target
            reward = MATCH_REWARD * self._won
            self._board[np.isin(self._board, PADS)] = EMPTY
        for place, step in list(self._picked.items()):
            if self._phase_step > step + APPLE_BACK_AFTER_STEPS:
                self._board[place] = APPLE
                del self._picked[place]
        return reward

    def _in_color(self) -> NDArray[np.uint8]:
        colors = {**GREYS_AND_MORE, **dict(zip(PADS, self._colors, strict=True))}
        image = np.array([[colors[str(cell)] for cell in row] for row in self._board], np.uint8)
        image[self._agent] = colors[AGENT]
        return image

    def _observation(self) -> NDArray[np.uint8]:
        row, column = self._agent
        padded = np.full((7 + 2 * REACH, 11 + 2 * REACH, 3), GREYS_AND_MORE[EMPTY], np.uint8)
        padded[REACH:-REACH, REACH:-REACH] = self._in_color()
        around = padded[row : row + 2 * REACH + 1, column : column + 2 * REACH + 1]
        return np.ascontiguousarray(around.transpose(2, 0, 1)).reshape(-1)

    def _is_success(self) -> bool:
        return self._won

    def _picture(self) -> NDArray[np.uint8]:
        return enlarged(self._in_color(), 32)
