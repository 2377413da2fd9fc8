"""Memory Maze: find the targets of a maze, then find the one that is asked for, again and again.

Rules: https://github.com/jurgisp/memory-maze/tree/4030901 (MIT), Pasukonis et al. 2022, "Evaluating long-term
memory in 3D mazes". Written again on dm_control and labmaze: there, the seed belongs to the constructor, and
the package needs the old `gym`. A seed gives the level that it gives there.
"""

import importlib.util
import platform
import sys
import warnings
from typing import Any  # dm_control is untyped

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from vla_eval.base_tasks.drawing import INK, PAPER, SHOWN, enlarged
from vla_eval.base_tasks.env import BaseTaskEnv, Level
from vla_eval.base_tasks.headless import not_started, renderer_chosen
from vla_eval.errors import MissingDependencyError

IMAGE_PX, BORDER_PX, BORDER_BRIGHTNESS = 64, 2, 0.7
COLORS = (
    np.array(
        [
            [170, 38, 30],  # red
            [99, 170, 88],  # green
            [39, 140, 217],  # blue
            [93, 105, 199],  # purple
            [220, 193, 59],  # yellow
            [220, 128, 107],  # salmon
        ]
    )
    / 220
)
ACTIONS = ((0, 0), (-1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1))
"""Roll and steer: nothing, forward, left, right, forward and left, forward and right."""
MAX_SEED = 2**32  # of numpy's RandomState, which the original uses

PICTURE_FACTOR, MAP_PX = 4, 256
PACKAGES = ("dm_control", "labmaze")
LABMAZE_UP_TO = (3, 12)


class MemoryMazeEnv(BaseTaskEnv):
    """Walk through a maze to the target whose colour the border of the image has; then it changes.

    Observation (64, 64, 3) uint8: what the walker sees, in a border of 2 px. Actions: nothing, forward, left,
    right, forward and left, forward and right, for 0.25 s. Reward 1 for each prompted target that is touched.
    An episode ends at its horizon.
    """

    has_success = False

    def __init__(
        self,
        *,
        side: int,
        n_targets: int,
        rooms: dict[str, int],
        horizon_steps: int,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(horizon_steps=horizon_steps, render_mode=render_mode)
        check_packages()
        self.observation_space = gym.spaces.Box(0, 255, (IMAGE_PX, IMAGE_PX, 3), np.uint8)
        self.action_space = gym.spaces.Discrete(len(ACTIONS))
        self._colors = COLORS[:n_targets]
        self._maze_arguments = {"width": side + 2, "height": side + 2, **rooms}
        self._world: Any = None

    def true_state(self) -> Level:
        """Return what is hidden.

        `maze_layout` (side, side): 1 where one can walk, indexed (y, x). In cells, from the same corner:
        `targets_pos` (N, 2), (x, y); `agent_pos` (2,). `agent_dir` (2,): where it looks, a unit vector.
        `target`: index of the prompted one.
        """
        state: Level = self._world.state()
        return state

    def _begin(self, seed: int | None, level: Level | None) -> NDArray[np.uint8]:
        if self._world is None:
            self._world = make_world(self._colors, self._maze_arguments)
        is_usable = seed is not None and seed < MAX_SEED
        self._world.begin(seed if is_usable else int(self.np_random.integers(MAX_SEED)))
        return self._observation()

    def _advance(self, action: Any) -> tuple[NDArray[np.uint8], float, bool]:
        reward = self._world.advance(ACTIONS[action])
        return self._observation(), reward, False

    def _observation(self) -> NDArray[np.uint8]:
        seen: NDArray[np.uint8] = self._world.image()
        inside = slice(BORDER_PX, -BORDER_PX)
        image = np.empty_like(seen)
        image[:] = self._colors[self._world.prompted] * 255 * BORDER_BRIGHTNESS
        image[inside, inside] = seen[inside, inside]
        self._image = image.copy()
        return image

    def _picture(self) -> NDArray[np.uint8]:
        """Show what the walker sees, and beside it the map, which it does not see."""
        return np.hstack([enlarged(self._image, PICTURE_FACTOR), map_picture(self.true_state())])

    def close(self) -> None:
        """Free the world."""
        if self._world is not None:
            self._world.close()
            self._world = None


def map_picture(state: Level) -> NDArray[np.uint8]:
    """Draw the maze from above: walls dark, the prompted target ringed, the walker an arrow; y points up."""
    layout = state["maze_layout"]
    scale = MAP_PX / (len(layout) + 2)
    image = Image.new("RGB", (MAP_PX, MAP_PX), INK)
    draw = ImageDraw.Draw(image)

    def pixel(place: NDArray[np.float64]) -> tuple[float, float]:
        return (place[0] + 1) * scale, MAP_PX - (place[1] + 1) * scale

    def disc(place: NDArray[np.float64], radius: float, **style: Any) -> None:
        x, y = pixel(place)
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), **style)

    for y, x in np.argwhere(layout):
        (left, bottom), (right, top) = pixel(np.array([x, y])), pixel(np.array([x + 1, y + 1]))
        draw.rectangle((left, top, right, bottom), fill=PAPER)
    for k, place in enumerate(state["targets_pos"]):
        disc(place, 0.3 * scale, fill=tuple((COLORS[k] * 255).astype(int).tolist()))
    disc(state["targets_pos"][int(state["target"])], 0.45 * scale, outline=INK, width=2)
    ahead = state["agent_dir"]
    aside = np.array([-ahead[1], ahead[0]])
    corners = [0.45 * ahead, 0.25 * aside - 0.3 * ahead, -0.25 * aside - 0.3 * ahead]
    draw.polygon([pixel(state["agent_pos"] + corner) for corner in corners], fill=INK, outline=SHOWN)
    return np.asarray(image)


def check_packages() -> None:
    """Raise the error that says what to install; nothing is imported.

    Raises:
        MissingDependencyError: labmaze is not there, and has no wheel for this Python.
        ModuleNotFoundError: a package is not installed.
    """
    for package in PACKAGES:
        if importlib.util.find_spec(package) is not None:
            continue
        if package == "labmaze" and sys.version_info[:2] > LABMAZE_UP_TO:
            raise MissingDependencyError(
                "Memory Maze needs Python 3.12: labmaze, which draws its mazes, has no wheel for Python "
                f"{platform.python_version()}. All else of MIKASA-Base works here."
            )
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)


def make_world(colors: NDArray[np.float64], maze_arguments: dict[str, int]) -> Any:
    """Import dm_control with a renderer that needs no screen, and return a world.

    Raises:
        MissingDependencyError: there is no library to render by.
        RenderingError: there is one, but it does not start.
    """
    with renderer_chosen(), warnings.catch_warnings():  # dm_control changes the filters
        try:
            from vla_eval.base_tasks import memory_maze_world
        except ModuleNotFoundError:
            raise
        except (AttributeError, ImportError, RuntimeError) as exc:  # PyOpenGL's ways to say it
            raise not_started(exc) from exc
        return memory_maze_world.World(colors=colors, maze_arguments=maze_arguments, image_px=IMAGE_PX)
