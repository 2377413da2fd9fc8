"""Players of ViZDoom-Two-Colors."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player

LEFT, RIGHT, FORWARD, BACK, LEFT_FORWARD, _, RIGHT_FORWARD, _ = range(8)
FULL_HEALTH = 100
ACID_WEST, ACID_EAST = -768, 512  # outside are the rooms of Delay1000
BLOCK_END = np.array([200.0, -512.0])  # around the western end of the block in the acid room
BLOCK_WEST, BLOCK_Y = 256 - 32, -512
TOUCH = 40.0  # between centres, so that a vest is taken
NEAR = 70.0
DETOUR = 160.0  # what a wrong vest in the way costs, in map units
STRAIGHT_DEG, WIDE_DEG = 5.0, 40.0
RED_MIN, RED_RATIO = 60, 2.0  # of a pixel that counts as red
WHITE_MIN, WHITE_SPREAD = 100, 60
FLOOR_ROW = 34  # of the image, whose horizon is above it
THING_PX, STRAIGHT_PX = 8, 5

Place = NDArray[np.float64]


class Oracle(Player):
    """Walks to the nearest vest of the pillar's colour or to the nearest medikit; knows where things are."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the action."""
        x, y, degrees = state["pose"]
        here = np.array([x, y])
        vests = state["vests"]
        is_right = vests[:, 0] == state["is_red"]
        is_here = (vests[:, 1] > ACID_EAST) == (x > ACID_EAST)
        if x < ACID_WEST:
            return LEFT
        goals, wrong = vests[is_right & is_here, 1:], vests[~is_right & is_here, 1:]
        if len(state["medikits"]) and x <= ACID_EAST:
            goals = state["medikits"]
        if not len(goals):
            return LEFT
        goal = min(goals, key=lambda one: _cost(here, one, wrong))
        is_wasted = state["health"] >= FULL_HEALTH and x <= ACID_EAST
        if is_wasted and np.linalg.norm(goal - here) < NEAR:
            return BACK  # taken now, it would heal nothing
        if x <= ACID_EAST and _is_behind_block(here, goal):
            goal = BLOCK_END
        return _towards(here, degrees, goal)


def _towards(here: Place, degrees: float, goal: Place) -> int:
    ahead = np.degrees(np.arctan2(*(goal - here)[::-1]))
    error = (ahead - degrees + 180) % 360 - 180
    if abs(error) < STRAIGHT_DEG:
        return FORWARD
    if abs(error) < WIDE_DEG:
        return LEFT_FORWARD if error > 0 else RIGHT_FORWARD
    return LEFT if error > 0 else RIGHT


def _cost(here: Place, goal: Place, wrong: Place) -> float:
    """Return the way to a place in map units, with what lies in the way."""
    way = goal - here
    length = float(np.linalg.norm(way))
    along = np.clip((wrong - here) @ way / max(length**2, 1.0), 0, 1)
    misses = np.linalg.norm(here + along[:, None] * way - wrong, axis=1)
    return length + DETOUR * int((misses < TOUCH).sum())


def _is_behind_block(here: Place, goal: Place) -> bool:
    """Whether the straight way crosses the block."""
    (x, y), (goal_x, goal_y) = here, goal
    if (y - BLOCK_Y) * (goal_y - BLOCK_Y) >= 0:
        return False
    return bool(x + (goal_x - x) * (BLOCK_Y - y) / (goal_y - y) > BLOCK_WEST)


class RedInView(Player):
    """Walks to the nearest red thing in view, whatever colour the pillar had; turns left until one is.

    In Delay1000, which has vests in the last room only, it walks to white things, medikits, if none is red.
    """

    def act(self, observation: Any, state: Level) -> int:
        """Return the action."""
        low, middle, high = np.moveaxis(np.sort(observation.astype(np.int64), axis=-1), -1, 0)
        is_red = (high == observation[..., 0]) & (high > RED_MIN) & (high > RED_RATIO * middle)
        is_white = (low > WHITE_MIN) & (high - low < WHITE_SPREAD)
        is_white[:FLOOR_ROW] = False
        rows, columns = np.nonzero(is_red)
        if not len(rows) and self.arguments["level"] == "delay1000":
            rows, columns = np.nonzero(is_white)
        if not len(rows):
            return LEFT
        nearest = columns[rows.argmax()]  # the lowest in the image
        of_it = columns[np.abs(columns - nearest) <= THING_PX]
        error = float(of_it.mean()) - (observation.shape[1] - 1) / 2
        if abs(error) < STRAIGHT_PX:
            return FORWARD
        return LEFT_FORWARD if error < 0 else RIGHT_FORWARD
