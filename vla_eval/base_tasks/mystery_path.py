"""Mystery Path: find an invisible path by trial, and follow it.

Rules: https://github.com/MarcoMeter/endless-memory-gym/blob/a94f2b6/memory_gym/mystery_path.py (MIT). Drawn
again, as its package pins versions that do not install.
"""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pygame
from numpy.typing import NDArray

from vla_eval.base_tasks.drawing import enlarged
from vla_eval.base_tasks.env import BaseTaskEnv, Level
from vla_eval.base_tasks.walker import RADIUS_PX, SCREEN_PX, Walker, pixels

SIDE, TILE_PX = 7, 12
WALL_PERCENT, MAX_COST = 33, 9
N_BORDER_WALLS = (4, 8)
GOAL_REWARD, PATH_REWARD = 1.0, 0.1
CROSS_PX, CROSS_WIDTH_PX, RED = 10, 3, (255, 0, 0)
NEXT = ((1, 0), (-1, 0), (0, 1), (0, -1))
DIAGONAL = ((1, 1), (-1, -1), (1, -1), (-1, 1))

Tile = tuple[int, int]


class MysteryPathEnv(BaseTaskEnv):
    """Walk from the start of an invisible path to its end; off the path one is put back to the start.

    Observation (84, 84, 3) uint8, indexed (x, y): the figure, and a red cross where it left the path.
    Action: horizontal 0 none, 1 left, 2 right; vertical 0 none, 1 up, 2 down; the one after a cross is lost.
    Reward 0.1 for each new tile of the path between its ends, 1 at its end.
    """

    level_names = ("path",)

    def __init__(self, *, horizon_steps: int, render_mode: str | None = None) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        self.observation_space = gym.spaces.Box(0, 255, (SCREEN_PX, SCREEN_PX, 3), np.uint8)
        self.action_space = gym.spaces.MultiDiscrete([3, 3])
        self._screen = pygame.Surface((SCREEN_PX, SCREEN_PX))

    def true_state(self) -> Level:
        """Return `path` (N, 2), tiles (x, y) from start to end, and the `centre` of the figure in px."""
        return {"path": np.array(self._path), "centre": np.array(self._walker.centre)}

    def _begin(self, seed: int | None, level: Level | None) -> NDArray[np.uint8]:
        if level is None:
            self._path = drawn_path(self.np_random)
        else:
            self._path = [(int(x), int(y)) for x, y in level["path"]]
        self._walker = Walker(_centre(self._path[0]), low_px=0, high_px=SCREEN_PX)
        self._visited: set[Tile] = set()
        self._is_off = self._has_won = False
        return self._observation()

    def _advance(self, action: Any) -> tuple[NDArray[np.uint8], float, bool]:
        if self._is_off:
            self._walker.centre = _centre(self._path[0])
        else:
            self._walker.move(action.tolist())
        tile = self._tile()
        self._has_won = tile == self._path[-1]
        if self._has_won:
            return self._observation(), GOAL_REWARD, True
        self._is_off = tile not in self._path
        is_new = tile in self._path[1:-1] and tile not in self._visited
        self._visited.add(tile)
        return self._observation(), PATH_REWARD if is_new else 0.0, False

    def _tile(self) -> Tile:
        x, y = (number // TILE_PX for number in self._walker.centre)
        return x, y

    def _observation(self) -> NDArray[np.uint8]:
        self._screen.fill(0)
        self._walker.draw(self._screen)
        if self._is_off:
            cross, last = pygame.Surface((CROSS_PX, CROSS_PX)), CROSS_PX - 1
            cross.set_colorkey(0)
            pygame.draw.line(cross, RED, (0, 0), (last, last), CROSS_WIDTH_PX)
            pygame.draw.line(cross, RED, (last, 0), (0, last), CROSS_WIDTH_PX)
            self._screen.blit(cross, cross.get_rect(center=self._walker.centre))
        return pixels(self._screen)

    def _is_success(self) -> bool:
        return self._has_won

    def _picture(self) -> NDArray[np.uint8]:
        """Show the path, too, which the player does not see."""
        picture = pixels(self._screen)
        for x, y in self._path:
            tile = picture[TILE_PX * x : TILE_PX * (x + 1), TILE_PX * y : TILE_PX * (y + 1)]
            tile[(tile == 0).all(axis=-1)] = (0, 90, 60) if (x, y) == self._path[-1] else (60, 60, 60)
        return enlarged(picture.transpose(1, 0, 2), 4)


def drawn_path(rng: np.random.Generator) -> list[Tile]:
    """Draw a path from one side to the opposite one, with the draws of the original."""
    last, side = SIDE - 1, int(rng.integers(4))
    ends = [int(rng.integers(SIDE)), int(rng.integers(SIDE))]
    start, end = ((0, ends[0]), (last, ends[1])) if side < 2 else ((ends[0], 0), (ends[1], last))
    if side % 2:
        (start, end) = ((last, ends[0]), (0, ends[1])) if side < 2 else ((ends[0], last), (ends[1], 0))
    walls = {
        (x, y)
        for x in range(1, SIDE - 2)
        for y in range(1, SIDE - 2)
        if int(rng.integers(100)) < WALL_PERCENT
    }
    free = _border_without_neighbours(walls, start, end)
    for _ in range(N_BORDER_WALLS[int(rng.integers(len(N_BORDER_WALLS)))]):
        if free:
            walls.add(free.pop(int(rng.integers(len(free)))))
    return _wandering_path(rng, start, end, walls)


def _border_without_neighbours(walls: set[Tile], start: Tile, end: Tile) -> list[Tile]:
    """Return the cells at the border that touch no wall and are neither ends nor beside one."""
    taken = {start, end, *_near(start, NEXT), *_near(end, NEXT)}
    return [
        (x, y)
        for x in range(SIDE)
        for y in range(SIDE)
        if (x in (0, SIDE - 1) or y in (0, SIDE - 1))
        and (x, y) not in taken
        and not walls & set(_near((x, y), (*NEXT, *DIAGONAL)))
    ]


def _wandering_path(rng: np.random.Generator, start: Tile, end: Tile, walls: set[Tile]) -> list[Tile]:
    """Search as A* does, with random costs and the original's oddities, which make the path wander.

    The next cell is the first whose estimate is below that of the first in the list. If a cell that is
    already in the list is reached at lower cost, its predecessor changes, but not its cost.
    """
    waiting, done = [start], set[Tile]()
    cost, estimate, before = {start: 0}, {start: 0.0}, dict[Tile, Tile]()
    while waiting:
        better = (tile for tile in waiting if estimate[tile] < estimate[waiting[0]])
        here = next(better, waiting[0])
        if here == end:
            return _traced(before, end)
        waiting.remove(here)
        done.add(here)
        for near in _near(here, NEXT):
            if near in done or near in walls:
                continue
            new_cost = cost[here] + int(rng.integers(1, MAX_COST))
            if near not in waiting:
                waiting.append(near)
                cost[near] = new_cost
            elif new_cost >= cost[near]:
                continue
            estimate[near] = cost[near] + math.dist(near, end)
            before[near] = here
    raise AssertionError("walls never close off the end: the border cells beside both ends stay free")


def _traced(before: dict[Tile, Tile], end: Tile) -> list[Tile]:
    path = [end]
    while path[-1] in before:
        path.append(before[path[-1]])
    return path[::-1]


def _near(tile: Tile, moves: tuple[Tile, ...]) -> list[Tile]:
    cells = [(tile[0] + dx, tile[1] + dy) for dx, dy in moves]
    return [cell for cell in cells if all(0 <= number < SIDE for number in cell)]


def _centre(tile: Tile) -> tuple[int, int]:
    return TILE_PX * tile[0] + RADIUS_PX, TILE_PX * tile[1] + RADIUS_PX
