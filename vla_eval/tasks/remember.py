"""The Remember tasks: an item is shown, hidden, and must be recognised among others.

The items differ in colour, in shape, or in both. There is one class for each case, which defines the items;
the phases are the same.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.seeding import Stream
from vla_eval.tasks.item_choice import ItemChoiceEnv
from vla_eval.tasks.objects import limits
from vla_eval.tasks.objects.bodies import Flags, Steps, anywhere
from vla_eval.tasks.objects.item_names import MIXED_SHAPE_NAMES, N_MIXED_COLORS
from vla_eval.tasks.objects.items import COLORS, CUBE_HALF_SIZE_M, SHAPES, Item, Shape, cube
from vla_eval.tasks.objects.layout import Plane, jittered_apart, slot_centres_m
from vla_eval.tasks.objects.limits import (
    CubeHalfSize,
    ItemCount,
    MeshScale,
    MixedColorCount,
    MixedShapeCount,
    Positive,
    ThingCount,
)
from vla_eval.tasks.objects.meshes import read_meshes
from vla_eval.tasks.objects.things import THINGS
from vla_eval.tasks.tensors_out import Info

SHAPE_COLOR = COLORS[2]  # blue, as in the official RememberShape
MIXED_COLORS = COLORS[:N_MIXED_COLORS]


class RememberEnv(ItemChoiceEnv):
    """Find the item that was shown before.

    Description: an item lies at the centre of the table (cue), then the table is empty (delay), then N
    items, including that one, lie at N places in random order (response).

    The families below define the items. Everything else is the same:

    Observation space: `state` adds the oracle's numbers, and 3 per item, its position if it is the right
    one, else 0.

    Rewards: dense: reach 1 + slow down 0.5 + stand still 0.5, or 3 if solved; see `docs/tasks.md`.

    Starting state: arm at rest with joint noise of 0.02 rad; item uniform; places permuted uniformly.

    Episode end: 60 control steps; success and failure are reported but end nothing by themselves.

    Chance level: 1 / N for a perfect arm that ignores the cue.

    Version history: 1, first version.
    """

    MAX_REWARD = 3.0
    REACH_SCALE_PER_M = 10.0
    SLOWING_WEIGHT = 0.5
    RESTING_WEIGHT = 0.5
    SLOWS_ANYWHERE = True  # official code

    def __init__(self, *args: Any, goal_threshold_m: Positive = 0.05, **kwargs: Any) -> None:
        super().__init__(*args, goal_threshold_m=goal_threshold_m, **kwargs)

    def _load_scene(self, options: dict[str, Any]) -> None:
        super()._load_scene(options)
        self._drawn = np.zeros_like(self._target)

    def _sample_episode(self, env: int) -> None:
        self._drawn[env] = int(self.episode_generator(env, Stream.TARGET).integers(self.n_items))
        self._target[env] = (self._drawn[env] + self.swap_cue) % self.n_items
        self._sample_slots(env)
        self._sample_distractor(env, {int(self._drawn[env]), int(self._target[env])})

    def n_swaps(self) -> int:
        """Return how many other items could be shown."""
        return limits.n_swaps(n_items=self.n_items)

    def _on_phase_edges(self, step: Steps, mask: Flags) -> bool:
        if not anywhere(step <= self._response_step):  # most steps of an episode
            return False
        cue_begins = mask & (step == self.cue_after_steps) & (self._cue_end_step > step) & self.show_cue
        cue_ends = mask & (step == self._cue_end_step) & (step > 0)
        choice_begins = mask & (step == self._response_step)
        self._show_in_middle(cue_begins, self._drawn, self._target)
        self._park_all(cue_ends)
        distracts = self._distract(step, mask)
        self._reveal_all(choice_begins)
        return anywhere(cue_begins | cue_ends | distracts | choice_begins)

    def _privileged_extra(self) -> Info:
        positions = self.candidate_positions_m()
        extra: Info = {"oracle_info": self.oracle_info()}
        for index in range(self.n_items):
            is_target = (self._target == index)[:, None]
            extra[f"goal_{index}_pose"] = np.where(is_target, positions[:, index], np.float32(0))
        return extra


class RememberColorEnv(RememberEnv):
    """RememberColor: find the cube that has the colour shown before; see `RememberEnv`.

    Arguments: `n_items` 2 to 9, `cube_half_size_m` 0.01 to 0.03, and those of `RememberEnv`, `ChoiceEnv`
    and `MemoryTableEnv`.
    """

    FAMILY = 1

    def __init__(
        self,
        *args: Any,
        n_items: ItemCount = 3,
        cube_half_size_m: CubeHalfSize = CUBE_HALF_SIZE_M,
        **kwargs: Any,
    ) -> None:
        limits.check(ItemCount, n_items=n_items)
        shape = cube(cube_half_size_m)
        super().__init__(*args, items=tuple(Item(shape, color) for color in COLORS[:n_items]), **kwargs)


class RememberShapeEnv(RememberEnv):
    """RememberShape: find the blue item that has the shape shown before; see `RememberEnv`.

    Arguments: `n_items` 2 to 9, and those of `RememberEnv`, `ChoiceEnv` and `MemoryTableEnv`.
    """

    FAMILY = 4

    def __init__(self, *args: Any, n_items: ItemCount = 3, **kwargs: Any) -> None:
        limits.check(ItemCount, n_items=n_items)
        shapes = list(SHAPES.values())[:n_items]
        super().__init__(*args, items=tuple(Item(shape, SHAPE_COLOR) for shape in shapes), **kwargs)


class RememberObjectEnv(RememberEnv):
    """RememberObject: find the everyday thing that was shown before; see `RememberEnv`.

    Source: the paper, section "Extending atomic tasks with realistic object distributions", which replaces
    the cubes of RememberColor by randomly sampled objects of YCB. Here they are twelve small things made of
    primitives (`objects/things.py`), and a task with N has the first N of them; or meshes of a folder.

    Arguments: `n_items` 2 to 12, `meshes` (a folder; the first N of its meshes by name, see
    `objects/meshes.py`), `mesh_scale`, `mesh_holes` (surfaces need not be closed), and those of
    `RememberEnv`, `ChoiceEnv` and `MemoryTableEnv`.
    """

    FAMILY = 12

    def __init__(
        self,
        *args: Any,
        n_items: ThingCount = 3,
        meshes: str | None = None,
        mesh_scale: MeshScale = 1.0,
        mesh_holes: bool = False,
        **kwargs: Any,
    ) -> None:
        limits.check(ThingCount, n_items=n_items)
        limits.check(MeshScale, mesh_scale=mesh_scale)
        limits.check_together(meshes=meshes, mesh_scale=mesh_scale, mesh_holes=mesh_holes)
        shapes = list(THINGS.values())[:n_items]
        if meshes is not None:
            found = read_meshes(meshes, scale=mesh_scale, allow_holes=mesh_holes).candidates(n_items)
            shapes = [
                Shape(name=mesh.name, parts=(), rest_height_m=mesh.solid.height_m / 2, solid=mesh.solid)
                for mesh in found
            ]
            self.candidate_names = tuple(mesh.name for mesh in found)
        super().__init__(*args, items=tuple(map(Item, shapes)), **kwargs)

    def _places_m(self, rng: np.random.Generator) -> Plane:
        return jittered_apart(slot_centres_m(self.n_items), rng)


class RememberShapeAndColorEnv(RememberEnv):
    """RememberShapeAndColor: find the item that has shape and colour shown before; see `RememberEnv`.

    Arguments: `n_shapes` 1 to 5, `n_colors` 1 to 3, `official_3x2` (two shapes in three colours, which the
    official code calls three shapes in two colours), and those of the base classes.
    """

    FAMILY = 5

    def __init__(
        self,
        *args: Any,
        n_shapes: MixedShapeCount = 3,
        n_colors: MixedColorCount = 2,
        official_3x2: bool = False,
        **kwargs: Any,
    ) -> None:
        limits.check(MixedShapeCount, n_shapes=n_shapes)
        limits.check(MixedColorCount, n_colors=n_colors)
        limits.check_together(n_shapes=n_shapes, n_colors=n_colors, official_3x2=official_3x2)
        if official_3x2:
            n_shapes, n_colors = 2, 3
        self.n_shapes, self.n_colors = n_shapes, n_colors
        items = [
            Item(SHAPES[s], color) for s in MIXED_SHAPE_NAMES[:n_shapes] for color in MIXED_COLORS[:n_colors]
        ]
        super().__init__(*args, items=tuple(items), **kwargs)

    def stream_key(self) -> tuple[int, ...]:
        """Return the family's number and how many shapes and colours there are."""
        return (self.FAMILY, self.n_shapes, self.n_colors)

    def _places_m(self, rng: np.random.Generator) -> Plane:
        return jittered_apart(slot_centres_m(self.n_items), rng)

    def oracle_info(self) -> NDArray[np.uint8]:
        """Return (B, 2): the right shape's and the right colour's number."""
        shape, color = self._target // self.n_colors, self._target % self.n_colors
        return np.stack((shape, color), axis=1).astype(np.uint8)
