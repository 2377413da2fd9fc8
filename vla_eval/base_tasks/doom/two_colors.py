"""ViZDoom-Two-Colors: a pillar shows for a moment which vests heal; the acid floor hurts all the time.

Rules: griver/memup at d276571 (no licence: rules and measured numbers only; nothing of its map files) and
https://github.com/CognitiveAISystems/MIKASA-Base/blob/ac81b6f/mikasa_base/ViZDoom_Two_Colors/env/env_vizdoom.py.
The map and its scripts are made here, `two_colors_map.py`. A seed gives the episode that it gives there:
health, position and reward of each step are equal in all recorded episodes. No recorded episode shows the
later medikits and the last room of Delay1000: they follow the rules alone. Images depend on the Freedoom of
the installed vizdoom.
"""

import contextlib
import functools
import os
import shlex
import shutil
import tempfile
import weakref
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import vizdoom
from numpy.typing import NDArray

from vla_eval.base_tasks.doom import two_colors_map as maps
from vla_eval.base_tasks.env import BaseTaskEnv, Level
from vla_eval.errors import RenderingError, check_names

HEIGHT_PX, WIDTH_PX = 64, 112
TICS = 4  # of a step; 35 of them are a second
ROSE = 1.0  # reward of a step in which health rose
N_SEEDS = 1 << 32  # of ZDoom
BUTTONS = (
    vizdoom.Button.TURN_LEFT,
    vizdoom.Button.TURN_RIGHT,
    vizdoom.Button.MOVE_FORWARD,
    vizdoom.Button.MOVE_BACKWARD,
)
ACTIONS = (
    (1, 0, 0, 0),
    (0, 1, 0, 0),
    (0, 0, 1, 0),
    (0, 0, 0, 1),
    (1, 0, 1, 0),
    (1, 0, 0, 1),
    (0, 1, 1, 0),
    (0, 1, 0, 1),
)
"""Action -> which of `BUTTONS` are pressed."""
VESTS = {"GreenArmor": 0, "BlueArmor": 1}
"""Class of Doom -> whether it is red here."""

FOLDER_PREFIX = "mikasa-vla-doom-"  # what begins so may be written (vla_eval.lock)
KILLED_WITH_US = ("setpriv", "--pdeathsig", "KILL") if shutil.which("setpriv") else ()

Image = NDArray[np.uint8]


class TwoColorsEnv(BaseTaskEnv):
    """Remember the colour of a pillar and take vests of it.

    Observation (64, 112, 3) uint8. Action: 0 left, 1 right, 2 forward, 3 back, 4 left and forward, 5 left and
    back, 6 right and forward, 7 right and back; 4 tics each. The floor costs 8 health every 32 tics, a right
    vest heals 25, a wrong one costs 17 (green) or 13 (red). Reward 0.01 a tic alive, and 1 if health rose.
    Death ends the episode; its last image is the one before. Success: alive at the end.

    Delay1000 begins in a room without acid, of which the pillar is all that matters; then 2000 tics of acid
    with medikits; then one vest of each colour. Reward 1 if health rose; the choice pays nothing, as in the
    original, and ends the episode. Success: the vest has the pillar's colour.

    The game runs in a process of its own, which the first reset starts, with its files in a folder that is
    removed with it.
    """

    metadata = {**BaseTaskEnv.metadata, "render_fps": 35 // TICS}  # noqa: RUF012  gymnasium declares it so

    def __init__(self, *, level: str, horizon_steps: int, render_mode: str | None = None) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        check_names("level", [level], tuple(maps.LEVELS), where="ViZDoom-Two-Colors")
        self._level = maps.LEVELS[level]
        self.observation_space = gym.spaces.Box(0, 255, (HEIGHT_PX, WIDTH_PX, 3), np.uint8)
        self.action_space = gym.spaces.Discrete(len(ACTIONS))
        self._game: Any = None  # vizdoom.DoomGame, once it runs
        self._process_id = 0

    def true_state(self) -> Level:
        """Return what is hidden.

        `is_red` of the pillar; `vests` (n, 3): whether red, x, y; `medikits` (n, 2): x, y; `pose`: x, y,
        degrees; `health`; `shaping`, the original's other reward so far: 1 for a right vest, -1 for a wrong
        one.
        """
        variable = vizdoom.GameVariable
        place = (variable.POSITION_X, variable.POSITION_Y, variable.ANGLE)
        shaping = vizdoom.doom_fixed_to_double(self._value(variable.USER1))
        return {
            "is_red": np.array(bool(self._value(variable.USER2))),
            "vests": np.array(self._vests).reshape(-1, 3),
            "medikits": np.array(self._medikits).reshape(-1, 2),
            "pose": np.array([self._value(one) for one in place]),
            "health": np.array(self._value(variable.HEALTH)),
            "shaping": np.array(shaping),
        }

    def _begin(self, seed: int | None, level: Level | None) -> Image:
        self._start()
        known = seed is not None and seed < N_SEEDS
        self._game.set_seed(seed if known else int(self.np_random.integers(N_SEEDS)))
        self._game.new_episode()
        self._health = self._value(vizdoom.GameVariable.HEALTH)
        self._is_dead, self._choice = False, 0
        self._look()
        return self._observation()

    def _advance(self, action: Any) -> tuple[Image, float, bool]:
        reward = self._game.make_action(list(ACTIONS[action]), TICS)
        before, self._health = self._health, self._value(vizdoom.GameVariable.HEALTH)
        if self._health > before:
            reward += ROSE
        self._is_dead = self._game.is_player_dead()
        self._choice = int(self._value(vizdoom.GameVariable.USER3))
        self._look()
        return self._observation(), reward, self._is_dead or self._choice != 0

    def _is_success(self) -> bool:
        return self._choice == maps.RIGHT if self._level.is_delayed else not self._is_dead

    def _look(self) -> None:
        """Keep image and objects of this step; of one in which the player died, there are none."""
        state = self._game.get_state()
        if state is None:
            return
        self._frame: Image = state.screen_buffer.copy()
        places = [(one.name, one.position_x, one.position_y) for one in state.objects]
        self._vests = [(VESTS[name], x, y) for name, x, y in places if name in VESTS]
        self._medikits = [(x, y) for name, x, y in places if name == "Medikit"]

    def _value(self, variable: Any) -> float:
        return float(self._game.get_game_variable(variable))

    def _observation(self) -> Image:
        return resized(self._frame, HEIGHT_PX, WIDTH_PX)

    def _picture(self) -> Image:
        return self._frame.copy()

    def _start(self) -> None:
        """Start the game, unless it runs as this process's own."""
        if self._game is not None and self._process_id == os.getpid() and self._game.is_running():
            return
        self.close()
        folder = Path(tempfile.mkdtemp(prefix=FOLDER_PREFIX))
        self._game, self._process_id = vizdoom.DoomGame(), os.getpid()
        self._finalizer = weakref.finalize(self, _end, self._game, folder, os.getpid())
        (folder / "map.wad").write_bytes(maps.map_file(self._level))
        _configure(self._game, folder, self._level.living_reward)
        try:
            self._game.init()
        except _FAILURES as exc:
            self.close()
            raise RenderingError(
                f"ViZDoom {vizdoom.__version__} could not be started: {exc}. Does this run on this machine: "
                "python -c 'import vizdoom; vizdoom.DoomGame().init()'"
            ) from exc

    def close(self) -> None:
        """End the game's process and remove its folder."""
        if self._game is not None:
            if self._process_id != os.getpid():
                _INHERITED.append(self._game)
            self._finalizer()
            self._game = None
        super().close()


_FAILURES = (
    vizdoom.FileDoesNotExistException,
    vizdoom.MessageQueueException,
    vizdoom.SharedMemoryException,
    vizdoom.ViZDoomErrorException,
    vizdoom.ViZDoomUnexpectedExitException,
)
_INHERITED: list[Any] = []
"""Games of the process that this one was forked from: to destroy one would end it there."""


def _configure(game: Any, folder: Path, living_reward: float) -> None:
    program = Path(vizdoom.__file__).parent
    # The game makes a folder where it is started; the working directory of this process is not its to fill.
    # It would outlive a process that is killed, were there not setpriv, which most Linux systems have.
    started = shlex.join(["exec", *KILLED_WITH_US, str(program / "vizdoom")])
    starter = folder / "start"
    starter.write_text(f'#!/bin/sh\ncd {shlex.quote(str(folder))} && {started} "$@"\n')
    starter.chmod(0o700)
    game.set_vizdoom_path(str(starter))
    game.set_doom_game_path(str(program / "freedoom2.wad"))
    game.set_doom_scenario_path(str(folder / "map.wad"))
    game.set_doom_config_path(str(folder / "vizdoom.ini"))
    game.set_doom_map(maps.MAP)
    game.set_mode(vizdoom.Mode.PLAYER)
    game.set_window_visible(False)
    game.set_sound_enabled(False)
    game.set_screen_resolution(vizdoom.ScreenResolution.RES_320X180)
    game.set_screen_format(vizdoom.ScreenFormat.RGB24)
    for drawn in ("hud", "crosshair", "weapon", "decals", "particles", "screen_flashes"):
        getattr(game, f"set_render_{drawn}")(False)
    game.set_objects_info_enabled(True)
    game.set_available_buttons(list(BUTTONS))
    game.set_living_reward(living_reward)


def _end(game: Any, folder: Path, process_id: int) -> None:
    if process_id == os.getpid():
        with contextlib.suppress(*_FAILURES):  # it has ended by itself
            game.close()
        shutil.rmtree(folder, ignore_errors=True)


def resized(image: Image, height: int, width: int) -> Image:
    """Return (height, width, 3), between the nearest two rows and columns, as OpenCV's bilinear resize."""
    above, below, down = _between(image.shape[0], height)
    left, right, along = _between(image.shape[1], width)
    upper, lower = image[above], image[below]
    rows = upper + (lower.astype(np.float32) - upper) * down[:, None, None]
    first = rows[:, left]
    values = first + (rows[:, right] - first) * along[:, None]
    return np.rint(values).astype(np.uint8)


@functools.cache
def _between(n_found: int, size: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Return for each new pixel the two old ones around its middle, and how far it is from the first."""
    at = np.clip((np.arange(size) + 0.5) * n_found / size - 0.5, 0, n_found - 1)
    low = at.astype(np.int64)
    return low, np.minimum(low + 1, n_found - 1), (at - low).astype(np.float32)
