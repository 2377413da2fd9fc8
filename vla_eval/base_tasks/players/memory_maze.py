"""The player of Memory Maze that has the map."""

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.base_tasks.env import Level
from vla_eval.base_tasks.players.player import Player

FORWARD, LEFT, RIGHT, FORWARD_LEFT, FORWARD_RIGHT = 1, 2, 3, 4, 5
STRAIGHT_RAD, WIDE_RAD = 0.15, 1.2  # below: forward alone; above: turn alone
CLEARANCE, STEP = 0.12, 0.1  # in cells: from the walls, along the line of sight

Cell = tuple[int, int]
Place = NDArray[np.float64]


class Oracle(Player):
    """Walks the shortest way to the prompted target, across corners where nothing is in between."""

    def act(self, observation: Any, state: Level) -> int:
        """Return the action that turns and goes towards the farthest place of the way in sight."""
        layout, here = state["maze_layout"], state["agent_pos"]
        goal = state["targets_pos"][int(state["target"])]
        way = [*(np.array(cell[::-1]) + 0.5 for cell in shortest_way(layout, _cell(here), _cell(goal))), goal]
        ahead = next((place for place in reversed(way) if is_clear(layout, here, place)), way[0])
        return steering(state["agent_dir"], ahead - here)


def steering(direction: Place, wanted: Place) -> int:
    """Return the action for one who looks in a direction and wants to go in another."""
    angle = np.arctan2(direction[0] * wanted[1] - direction[1] * wanted[0], direction @ wanted)
    if abs(angle) < STRAIGHT_RAD:
        return FORWARD
    if abs(angle) < WIDE_RAD:
        return FORWARD_LEFT if angle > 0 else FORWARD_RIGHT
    return LEFT if angle > 0 else RIGHT


def shortest_way(layout: NDArray[np.uint8], start: Cell, goal: Cell) -> list[Cell]:
    """Return the cells (y, x) from the one after the start to the goal, by breadth-first search."""
    queue, before = deque([goal]), {goal: goal}
    while queue and start not in before:
        y, x = queue.popleft()
        for near in ((y + 1, x), (y - 1, x), (y, x + 1), (y, x - 1)):
            if near not in before and all(0 <= n < len(layout) for n in near) and layout[near]:
                before[near] = (y, x)
                queue.append(near)
    way = [start]
    while way[-1] != goal:
        way.append(before[way[-1]])
    return way[1:]


def is_clear(layout: NDArray[np.uint8], start: Place, end: Place) -> bool:
    """Whether the walker fits through on a straight line."""
    n_points = int(np.linalg.norm(end - start) / STEP) + 1
    line = start + np.linspace(0, 1, n_points + 1)[1:, None] * (end - start)
    corners = line[:, None] + CLEARANCE * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    cells = np.floor(corners.reshape(-1, 2)).astype(int)
    if (cells < 0).any() or (cells >= len(layout)).any():
        return False
    return bool(layout[cells[:, 1], cells[:, 0]].all())


def _cell(place: Place) -> Cell:
    x, y = (int(number) for number in np.floor(place))
    return y, x
