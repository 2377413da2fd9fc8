"""Mortar Mayhem: commands are shown one by one, then have to be carried out in time.

Rules: https://github.com/MarcoMeter/endless-memory-gym/blob/a94f2b6/memory_gym/mortar_mayhem.py (MIT). Drawn
again, as its package pins versions that do not install. There `success` is 1 also if the last command fails;
here all have to succeed.
"""

from typing import Any

import gymnasium as gym
import numpy as np
import pygame
from numpy.typing import NDArray

from vla_eval.base_tasks.drawing import enlarged
from vla_eval.base_tasks.env import BaseTaskEnv, Level
from vla_eval.base_tasks.walker import SCREEN_PX, Walker, pixels

SIDE, TILE_PX, ARENA_PX = 5, 14, 7  # tiles of a side, size of one, where the arena begins
N_COMMANDS, SHOWN_STEPS, BLANK_STEPS = 10, 3, 1
FIRST_CHECK, PERIOD, DEADLY_STEPS = 19, 24, 6  # counted in steps of movement
REWARD = 0.1
SYMBOL_PX, SYMBOL_AT = 22, 31
WHITE = (255, 255, 255)
SAFE, DEADLY = ((21, 43, 77), (29, 60, 107)), ((81, 18, 26), (112, 24, 36))  # fill and frame of a tile

COMMANDS = {
    "right": (1, 0),
    "down": (0, 1),
    "left": (-1, 0),
    "up": (0, -1),
    "stay": (0, 0),
    "right_down": (1, 1),
    "right_up": (1, -1),
    "left_down": (-1, 1),
    "left_up": (-1, -1),
}
"""Name -> tiles to go, in the order in which the original draws them."""
TURNED = {
    "right": 0,
    "right_up": 45,
    "up": 90,
    "left_up": 135,
    "left": 180,
    "left_down": 225,
    "down": 270,
    "right_down": 315,
}
"""Degrees by which the arrow to the right is turned."""

Tile = tuple[int, int]


class MortarMayhemEnv(BaseTaskEnv):
    """Remember ten commands, then be on the right tile at each check.

    Observation (84, 84, 3) uint8, indexed (x, y). Action: horizontal 0 none, 1 left, 2 right; vertical 0
    none, 1 up, 2 down; without effect while commands are shown. Reward 0.1 for each command carried out; a
    wrong tile ends the episode, at a check and as long as the other tiles are red.
    """

    level_names = ("commands", "tile")

    def __init__(self, *, horizon_steps: int, render_mode: str | None = None) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        self.observation_space = gym.spaces.Box(0, 255, (SCREEN_PX, SCREEN_PX, 3), np.uint8)
        self.action_space = gym.spaces.MultiDiscrete([3, 3])
        self._screen = pygame.Surface((SCREEN_PX, SCREEN_PX))

    def true_state(self) -> Level:
        """Return `commands` (10,), indices of `COMMANDS`; the first `tile`; `goal`; `centre` in px."""
        return {
            "commands": np.array(self._commands),
            "tile": np.array(self._start),
            "goal": np.array(self._goal()),
            "centre": np.array(self._walker.centre),
        }

    def _begin(self, seed: int | None, level: Level | None) -> NDArray[np.uint8]:
        if level is None:
            self._start = divmod(int(self.np_random.integers(SIDE**2)), SIDE)
            self._commands = self._drawn_commands()
        else:
            x, y = (int(number) for number in level["tile"])
            self._start, self._commands = (x, y), [int(index) for index in level["commands"]]
        self._goals = _goals(self._start, self._commands)
        x, y = (ARENA_PX + TILE_PX // 2 + TILE_PX * number for number in self._start)
        self._walker = Walker((x, y), low_px=ARENA_PX, high_px=ARENA_PX + SIDE * TILE_PX)
        self._time = self._n_right = 0
        return self._observation()

    def _drawn_commands(self) -> list[int]:
        commands, tile = [], self._start
        for _ in range(N_COMMANDS):
            valid = [index for index, move in enumerate(COMMANDS.values()) if _is_inside(_moved(tile, move))]
            commands.append(valid[int(self.np_random.integers(len(valid)))])
            tile = _moved(tile, tuple(COMMANDS.values())[commands[-1]])
        return commands

    def _advance(self, action: Any) -> tuple[NDArray[np.uint8], float, bool]:
        self._time += 1
        reward, is_over = 0.0, False
        if self._n_moves > 0:
            self._walker.move(action.tolist())
            check = self._check()
            if check is not None:
                is_right = self._tile() == self._goals[check]
                is_check = (self._n_moves - FIRST_CHECK) % PERIOD == 0
                if is_right and is_check:
                    self._n_right += 1
                    reward = REWARD
                is_over = not is_right or check == N_COMMANDS - 1
        return self._observation(), reward, is_over

    @property
    def _n_moves(self) -> int:
        """How many steps of movement there have been."""
        return self._time - N_COMMANDS * (SHOWN_STEPS + BLANK_STEPS) + 1

    def _check(self) -> int | None:
        """Return the command of the check that holds now: from the check on, while tiles are deadly."""
        check, since = divmod(self._n_moves - FIRST_CHECK, PERIOD)
        return check if check >= 0 and since < DEADLY_STEPS else None

    def _goal(self) -> Tile:
        """Return the tile on which the next step has to end, or to come closer to."""
        check, since = divmod(self._n_moves + 1 - FIRST_CHECK, PERIOD)
        due = check if since < DEADLY_STEPS else check + 1
        return self._goals[min(max(due, 0), N_COMMANDS - 1)]

    def _tile(self) -> Tile:
        x, y = ((number - ARENA_PX) // TILE_PX for number in self._walker.centre)
        return x, y

    def _observation(self) -> NDArray[np.uint8]:
        self._screen.fill(0)
        check = self._check() if self._n_moves > 0 else None
        for x in range(SIDE):
            for y in range(SIDE):
                fill, frame = SAFE if check is None or (x, y) == self._goals[check] else DEADLY
                area = (ARENA_PX + TILE_PX * x, ARENA_PX + TILE_PX * y, TILE_PX, TILE_PX)
                pygame.draw.rect(self._screen, fill, area)
                pygame.draw.rect(self._screen, frame, area, width=1)
        self._walker.draw(self._screen)
        index, within = divmod(self._time, SHOWN_STEPS + BLANK_STEPS)
        if index < N_COMMANDS and within < SHOWN_STEPS:
            name = tuple(COMMANDS)[self._commands[index]]
            self._screen.blit(_symbol(name), (SYMBOL_AT, SYMBOL_AT))
        return pixels(self._screen)

    def _is_success(self) -> bool:
        return self._n_right == N_COMMANDS

    def _picture(self) -> NDArray[np.uint8]:
        return enlarged(pixels(self._screen).transpose(1, 0, 2), 4)


def _symbol(name: str) -> pygame.Surface:
    surface = pygame.Surface((SYMBOL_PX, SYMBOL_PX))
    surface.set_colorkey(0)
    if name == "stay":
        pygame.draw.circle(surface, WHITE, (10, 10), radius=10, width=2)
        pygame.draw.line(surface, WHITE, (0, 9), (19, 9), width=2)
        return surface
    for start, end in (((0.5, 10), (20, 10)), ((20, 10), (10, 0)), ((20, 10), (10, 20))):
        pygame.draw.line(surface, WHITE, start, end, 2)
    return pygame.transform.rotate(surface, TURNED[name])


def _goals(start: Tile, commands: list[int]) -> list[Tile]:
    goals, tile = [], start
    for index in commands:
        tile = _moved(tile, tuple(COMMANDS.values())[index])
        goals.append(tile)
    return goals


def _moved(tile: Tile, move: Tile) -> Tile:
    return tile[0] + move[0], tile[1] + move[1]


def _is_inside(tile: Tile) -> bool:
    return all(0 <= number < SIDE for number in tile)
