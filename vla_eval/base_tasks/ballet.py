"""Ballet: dancers dance one after another, then one of the dances is named: walk to who danced it.

Rules: https://github.com/jinPrelude/gym-balletenv/tree/e28b56e (Apache-2.0), after Lampinen et al. 2021,
"Towards mental time travel". Written again, as pycolab does not run on today's Python.
"""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.drawing import enlarged
from vla_eval.base_tasks.env import BaseTaskEnv, Level

SIZE, TILE_PX, CENTRE = 11, 9, 5
N_MOVES = 16  # of a dance
PLACES = ((2, 2), (2, 5), (2, 8), (5, 2), (5, 8), (8, 2), (8, 5), (8, 8))
MOVES = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))  # N, NE, E … NW
WALL, AGENT = 40, 255  # grey

DANCES = {
    "circle_cw": "0244660022446602",
    "circle_ccw": "0644220066442206",
    "up_and_down": "0440044004400440",
    "left_and_right": "2662266226622662",
    "diagonal_uldr": "7337733773377337",
    "diagonal_urdl": "1551155115511551",
    "plus_cw": "0426406204264062",
    "plus_ccw": "0462402604624026",
    "times_cw": "1537517315375173",
    "times_ccw": "7351371573513715",
    "zee": "1662251552266151",
    "chevron_down": "7431051514570373",
    "chevron_up": "3075415150134737",
}
"""Name -> moves as indices of `MOVES`; a dance ends where it began."""

COLORS = {
    "red": (255, 0, 0),
    "green": (0, 255, 0),
    "blue": (0, 0, 255),
    "purple": (128, 0, 128),
    "orange": (255, 165, 0),
    "yellow": (255, 255, 0),
    "brown": (128, 64, 0),
    "pink": (255, 64, 255),
    "cyan": (0, 255, 255),
    "dark_green": (0, 100, 0),
    "dark_red": (100, 0, 0),
    "dark_blue": (0, 0, 100),
    "olive": (100, 100, 0),
    "teal": (0, 100, 100),
    "lavender": (215, 200, 255),
    "peach": (255, 210, 170),
    "rose": (255, 205, 230),
    "light_green": (200, 255, 200),
    "light_yellow": (255, 255, 200),
}


def _shapes() -> dict[str, NDArray[np.bool_]]:
    i, j = np.mgrid[:TILE_PX, :TILE_PX]
    radius = (i - 4) ** 2 + (j - 4) ** 2
    middle_rows, middle_columns = (i >= 3) & (i <= 5), (j >= 3) & (j <= 5)
    outer_columns, top, bottom = (j <= 2) | (j >= 6), i <= 2, i >= 6
    plus = middle_rows | middle_columns
    ex = (np.abs(i - j) <= 1) | (np.abs(8 - j - i) <= 1)
    return {
        "triangle": i >= 2 * np.abs(4 - j),
        "empty_square": (i < 2) | (i > 6) | (j < 2) | (j > 6),
        "plus": plus,
        "inverse_plus": ~plus,
        "ex": ex,
        "inverse_ex": ~ex,
        "circle": radius <= 16,
        "empty_circle": np.abs(radius - 16) < 6,
        "tee": middle_columns | top,
        "upside_down_tee": middle_columns | bottom,
        "h": outer_columns | middle_rows,
        "u": outer_columns | bottom,
        "upside_down_u": outer_columns | top,
        "vertical_stripes": j % 2 == 0,
        "horizontal_stripes": i % 2 == 0,
    }


SHAPES = _shapes()
"""Name -> (9, 9) mask."""


class Dancer(NamedTuple):
    """One dancer, by indices into the tables above."""

    place: int
    dance: int
    color: int
    shape: int


class BalletEnv(BaseTaskEnv):
    """Watch the dances, then walk to the dancer of the dance that is named.

    Observation: `image` (99, 99, 3) uint8, the room around the agent; `word`: 0 while dances are shown, then
    1 + the dance. Action: one of eight directions; without effect before the word. Reward 1 at the dancer who
    danced it, 0 at another one; both end the episode.

    Args:
        n_dancers: how many dance.
        delay_steps: pause after each dance.
        is_light: all dancers are red; places and shapes are the first n.
    """

    level_names = ("dancers", "target")

    def __init__(
        self,
        *,
        n_dancers: int,
        delay_steps: int,
        horizon_steps: int,
        is_light: bool = False,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        self._n_dancers, self._is_light = n_dancers, is_light
        self._period = N_MOVES - 1 + delay_steps
        side_px = SIZE * TILE_PX
        self.observation_space = gym.spaces.Dict(
            {
                "image": gym.spaces.Box(0, 255, (side_px, side_px, 3), np.uint8),
                "word": gym.spaces.Discrete(1 + len(DANCES)),
            }
        )
        self.action_space = gym.spaces.Discrete(len(MOVES))

    def true_state(self) -> Level:
        """Return `dancers` (n, 4): place, dance, colour, shape; `target`, whose dance is named; the agent."""
        return {
            "dancers": np.array(self._dancers),
            "target": np.array(self._target),
            "position": np.array(self._agent),
        }

    def _begin(self, seed: int | None, level: Level | None) -> dict[str, Any]:
        if level is None:
            self._draw()
        else:
            self._dancers = [Dancer(*map(int, row)) for row in level["dancers"]]
            self._target = int(level["target"])
        self._agent = (CENTRE, CENTRE)
        self._frame, self._reward = 0, 0.0
        return self._observation()

    def _draw(self) -> None:
        """Draw the level in the order of the original, so that a seed is its episode."""
        self._target = int(self.np_random.integers(self._n_dancers))
        sizes = (len(PLACES), len(DANCES), len(COLORS), len(SHAPES))
        places, dances, colors, shapes = ([*range(size)] for size in sizes)
        if self._is_light:
            places, shapes = places[: self._n_dancers], shapes[: self._n_dancers]
            colors = [0] * self._n_dancers
        for indices in (places, dances, colors, shapes):
            self.np_random.shuffle(indices)
        rows = zip(places, dances, colors, shapes, strict=False)
        self._dancers = [Dancer(*map(int, row)) for row, _ in zip(rows, range(self._n_dancers), strict=False)]

    def _advance(self, action: Any) -> tuple[dict[str, Any], float, bool]:
        is_over = self._is_asked() and self._move(MOVES[action])
        self._frame += 1
        return self._observation(), self._reward, is_over

    def _is_asked(self) -> bool:
        return self._frame >= self._n_dancers * self._period

    def _move(self, move: tuple[int, int]) -> bool:
        """Move the agent; return whether it came to a dancer."""
        row, column = self._agent[0] + move[0], self._agent[1] + move[1]
        if not (0 < row < SIZE - 1 and 0 < column < SIZE - 1):
            return False
        self._agent = (row, column)
        for index, dancer in enumerate(self._dancers):
            if PLACES[dancer.place] == self._agent:
                self._reward = float(index == self._target)
                return True
        return False

    def _place(self, index: int) -> tuple[int, int]:
        """Return where a dancer is at this frame."""
        dancer = self._dancers[index]
        n_done = min(max(self._frame - index * self._period + 1, 0), N_MOVES)
        row, column = PLACES[dancer.place]
        for move in tuple(DANCES.values())[dancer.dance][:n_done]:
            row, column = row + MOVES[int(move)][0], column + MOVES[int(move)][1]
        return row, column

    def _observation(self) -> dict[str, Any]:
        word = 1 + self._dancers[self._target].dance if self._is_asked() else 0
        return {"image": self._around_agent(), "word": word}

    def _room(self) -> NDArray[np.uint8]:
        room = np.zeros((SIZE * TILE_PX, SIZE * TILE_PX, 3), np.uint8)
        room[:TILE_PX] = room[-TILE_PX:] = WALL
        room[:, :TILE_PX] = room[:, -TILE_PX:] = WALL
        _tile(room, self._agent)[:] = AGENT
        for index, dancer in enumerate(self._dancers):
            color = tuple(COLORS.values())[dancer.color]
            shape = tuple(SHAPES.values())[dancer.shape]
            _tile(room, self._place(index))[:] = shape[..., None] * np.array(color, np.uint8)
        return room

    def _around_agent(self) -> NDArray[np.uint8]:
        """Return the room moved such that the agent is in the centre; outside it is black."""
        room, pad = self._room(), CENTRE * TILE_PX
        padded = np.pad(room, ((pad, pad), (pad, pad), (0, 0)))
        top, left = (TILE_PX * place for place in self._agent)
        return np.ascontiguousarray(padded[top : top + len(room), left : left + len(room)])

    def _is_success(self) -> bool:
        return self._reward > 0

    def _picture(self) -> NDArray[np.uint8]:
        return enlarged(self._room(), 2)


def _tile(room: NDArray[np.uint8], place: tuple[int, int]) -> NDArray[np.uint8]:
    top, left = (TILE_PX * number for number in place)
    return room[top : top + TILE_PX, left : left + TILE_PX]
