"""The world of Memory Maze in dm_control: a ball with a camera on its head, rooms, walls, half spheres.

Importing this opens a renderer: `memory_maze.py` does it when the first episode begins.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any  # dm_control and labmaze are untyped

import labmaze
import mujoco
import numpy as np
from dm_control import composer, mjcf
from dm_control.locomotion.arenas import covering, mazes
from dm_control.locomotion.tasks import random_goal_maze
from dm_control.locomotion.walkers import initializers, jumping_ball
from dm_control.mujoco.engine import Camera
from labmaze import assets
from numpy.random import RandomState
from numpy.typing import NDArray

from vla_eval.base_tasks.headless import not_started

CELL_M, WALL_HEIGHT_M, CAMERA_HEIGHT_M = 2.0, 1.5, 0.3
BALL_RADIUS_M, TARGET_RADIUS_M = 0.2, 0.6  # a target's centre lies on the floor
PHYSICS_STEP_S, CONTROL_STEP_S = 0.005, 0.25
DAMPING = {"roll": 5.0, "steer": 20.0}
STYLE, FLOOR, ROOM_FLOOR = "style_01", "blue", "blue_bright"
N_SIDE_BLOCKS = 3  # walls look alike within a block
N_WALL_DRAWS = 10  # the original draws a texture more than there are blocks
N_SEEDS = 2**31
WALL = "*"
CAMERA = "walker/egocentric"

Vector = NDArray[np.float64]


class _Maze(labmaze.RandomMaze):  # type: ignore[misc]  # untyped
    """A maze whose walls are numbered by the block that they are in."""

    def regenerate(self) -> None:
        super().regenerate()
        cells = np.asarray(self.entity_layer)
        bounds = [k * len(cells) // N_SIDE_BLOCKS for k in range(N_SIDE_BLOCKS + 1)]
        for k in range(N_SIDE_BLOCKS**2):
            row, column = divmod(k, N_SIDE_BLOCKS)
            block = cells[bounds[row] : bounds[row + 1], bounds[column] : bounds[column + 1]]
            block[block == WALL] = str(k)


class _Textures(composer.Entity):  # type: ignore[misc]  # untyped
    def _build(self, name: str, files: Mapping[str, str]) -> None:
        self._mjcf_root = mjcf.RootElement(model=name)
        self.textures = [
            self._mjcf_root.asset.add("texture", type="2d", name=key, file=file)
            for key, file in files.items()
        ]

    @property
    def mjcf_model(self) -> Any:
        return self._mjcf_root


class _Arena(mazes.MazeWithTargets):  # type: ignore[misc]  # untyped
    """Draws by the generator that it is given, where dm_control's own takes numpy's global one."""

    _texturing_geom_names: list[str]
    _texturing_material_names: list[str]

    def _build(self, maze_arguments: Mapping[str, Any]) -> None:
        self._maze_arguments = dict(maze_arguments)
        floors = assets.get_floor_texture_paths(STYLE)
        walls = _Textures("walls", assets.get_wall_texture_paths(STYLE))
        super()._build(
            maze=self._seeded_maze(0),
            xy_scale=CELL_M,
            z_height=WALL_HEIGHT_M,
            wall_textures={str(k): walls for k in range(N_WALL_DRAWS)},
            floor_textures=_Textures("floors", {name: floors[name] for name in (FLOOR, ROOM_FLOOR)}),
            name="maze",
        )

    def _seeded_maze(self, seed: int) -> _Maze:
        return _Maze(random_seed=seed, spawns_per_room=1, objects_per_room=1, **self._maze_arguments)

    def seed(self, seed: int) -> None:
        """Begin another series of mazes."""
        self._maze = self._seeded_maze(seed)

    def regenerate(self, random_state: RandomState) -> None:
        """Build the next maze of the series."""
        self._maze.regenerate()
        self._find_spawn_and_target_positions()
        for name in self._texturing_geom_names:
            self._mjcf_root.worldbody.geom[name].remove()
        for name in self._texturing_material_names:
            self._mjcf_root.asset.material[name].remove()
        self._texturing_geom_names.clear()
        self._texturing_material_names.clear()
        self._maze_body.geom.clear()
        self._current_wall_texture = {
            char: textures[int(random_state.randint(len(textures)))]
            for char, textures in self._wall_textures.items()
        }
        for char in self._wall_textures:
            self._make_wall_geoms(char)
        floor, room_floor = self._floor_textures
        for char in np.unique(self._maze.variations_layer):
            self._lay(str(char), floor if char == "." else room_floor)

    def _lay(self, char: str, texture: Any) -> None:
        """Cover one room, or all there is between the rooms."""
        tiles = covering.make_walls(self._maze.variations_layer, wall_char=char, make_odd_sized_walls=True)
        for k, (start, end) in enumerate(tiles):
            name = f"floor{char}_{k}"
            half_size = np.array([end.x - start.x, end.y - start.y]) / 2
            x, y = (start.x + end.x - 1) / 2 - self._x_offset, self._y_offset - (start.y + end.y - 1) / 2
            material = self._mjcf_root.asset.add(
                "material", name=name, texture=texture, texrepeat=2 * half_size
            )
            self._mjcf_root.worldbody.add(
                "geom",
                name=name,
                type="plane",
                material=material,
                pos=[x * CELL_M, y * CELL_M, 0.0],
                size=[*(half_size * CELL_M), CELL_M],
                contype=0,
                conaffinity=0,
            )
            self._texturing_material_names.append(name)
            self._texturing_geom_names.append(name)


class MazeTask(random_goal_maze.NullGoalMaze):  # type: ignore[misc]  # untyped
    """Touch the prompted target; then another one is prompted.

    Attributes:
        prompted: index of the target to touch.
        places: (N, 3) of the targets, in m.
    """

    def __init__(self, *, colors: NDArray[np.float64], maze_arguments: Mapping[str, Any]) -> None:
        ball = jumping_ball.RollingBallWithHead(
            camera_height=CAMERA_HEIGHT_M, initializer=initializers.NoOpInitializer()
        )
        for joint, damping in DAMPING.items():
            ball.mjcf_model.find("joint", joint).damping = damping
        super().__init__(
            ball,
            _Arena(maze_arguments),
            contact_termination=False,
            physics_timestep=PHYSICS_STEP_S,
            control_timestep=CONTROL_STEP_S,
        )
        self._spheres = [
            self._maze_arena.mjcf_model.worldbody.add(
                "geom",
                name=f"target_{k}",
                type="sphere",
                size=[TARGET_RADIUS_M],
                rgba=[*color, 1],
                contype=0,
                conaffinity=0,
            )
            for k, color in enumerate(colors)
        ]
        self.prompted, self.places = 0, np.zeros((len(colors), 3))
        self._touched: set[int] = set()

    def initialize_episode_mjcf(self, random_state: RandomState) -> None:
        """Draw a maze with room for all targets, where they lie, and which is prompted first."""
        self._maze_arena.seed(int(random_state.randint(N_SEEDS)))
        while True:
            self._maze_arena.regenerate(random_state)
            places = list(self._maze_arena.target_positions)
            random_state.shuffle(places)
            if len(places) >= len(self._spheres):
                break
        self.places = np.array(places[: len(self._spheres)])
        for sphere, place in zip(self._spheres, self.places, strict=True):
            sphere.pos = place
        self._touched.clear()
        self._prompt(random_state)
        # As in the original: the ball is in the middle of the maze before it is put where it begins, and what
        # it touches there counts in the first step.
        self.touch((0.0, 0.0, BALL_RADIUS_M))

    def ball(self, physics: Any) -> Vector:
        """Return the place of the ball, which changes with the physics."""
        (geom,) = self._walker.ground_contact_geoms
        place: Vector = physics.data.geom_xpos[physics.bind(geom).element_id]
        return place

    def touch(self, ball: Sequence[float]) -> None:
        """Notice which targets the ball touches."""
        for k, place in enumerate(self.places.tolist()):
            if math.dist(ball, place) < BALL_RADIUS_M + TARGET_RADIUS_M:
                self._touched.add(k)

    def reward(self, random_state: RandomState) -> float:
        """Return 1 and prompt another target if the prompted one was touched since the last reward."""
        is_touched = self.prompted in self._touched
        if is_touched:
            self._prompt(random_state)
        self._touched.clear()
        return float(is_touched)

    def _prompt(self, random_state: RandomState) -> None:
        self.prompted = int(random_state.randint(len(self._spheres)))
        while self.prompted in self._touched:
            self.prompted = int(random_state.randint(len(self._spheres)))

    def state(self, physics: Any) -> dict[str, NDArray[Any]]:
        """Return what is hidden; places are in cells, from the corner where x and y are smallest."""
        cells = np.asarray(self._maze_arena.maze.entity_layer)[1:-1, 1:-1]
        head = physics.bind(self._walker.root_body)
        middle = len(cells) / 2
        return {
            "maze_layout": (~np.char.isdigit(cells[::-1])).astype(np.uint8),
            "targets_pos": self.places[:, :2] / CELL_M + middle,
            "target": np.array(self.prompted),
            "agent_pos": np.array(head.xpos[:2]) / CELL_M + middle,
            "agent_dir": np.reshape(head.xmat, (3, 3))[:2, 1].copy(),
        }


class World:
    """One maze after another, and what the camera on the ball sees."""

    def __init__(self, *, colors: Vector, maze_arguments: Mapping[str, Any], image_px: int) -> None:
        self._task = MazeTask(colors=colors, maze_arguments=maze_arguments)
        self._image_px = image_px
        self._random_state = RandomState(0)
        self._physics: Any = None
        self._camera: Any = None

    @property
    def prompted(self) -> int:
        """Index of the target to touch."""
        return self._task.prompted

    def begin(self, seed: int) -> None:
        """Draw the level of a seed, as the original does, and begin there."""
        self.close()
        self._random_state = RandomState(seed)
        self._task.initialize_episode_mjcf(self._random_state)
        self._physics = mjcf.Physics.from_mjcf_model(self._task.root_entity.mjcf_model)
        with self._physics.reset_context():
            self._task.initialize_episode(self._physics, self._random_state)
        self._ball = self._task.ball(self._physics)
        side = self._image_px
        try:
            self._camera = Camera(self._physics, height=side, width=side, camera_id=CAMERA)
        except (RuntimeError, mujoco.FatalError) as exc:  # as it opens the renderer
            raise not_started(exc) from exc

    def advance(self, action: Sequence[float]) -> float:
        """Execute one step and return its reward."""
        self._physics.set_control(action)
        model, data = self._physics.model.ptr, self._physics.data.ptr
        with self._physics.check_invalid_state():
            for _ in range(self._task.physics_steps_per_control_step):
                mujoco.mj_step2(model, data)  # in this order, places are those after the step
                mujoco.mj_step1(model, data)
                self._task.touch(self._ball.tolist())
        return self._task.reward(self._random_state)

    def image(self) -> NDArray[np.uint8]:
        """Draw what is seen now."""
        return np.array(self._camera.render())

    def state(self) -> dict[str, NDArray[Any]]:
        """Return what is hidden."""
        return self._task.state(self._physics)

    def close(self) -> None:
        """Free the model and the renderer."""
        self._camera = None
        if self._physics is not None:
            self._physics.free()
            self._physics = None
