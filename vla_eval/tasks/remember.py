"""The Remember tasks: an item is shown, hidden, and must be recognised among others.

What tells the items apart is their colour, their shape, or both: one class each, which says what the
items are; the phases are the same.
"""

import math
from typing import Any

import numpy as np
import sapien
import torch
from numpy.typing import NDArray

from vla_eval.errors import TaskArgumentError
from vla_eval.tasks.choice import ChoiceEnv
from vla_eval.tasks.items import COLORS, SHAPES, Item, build_item
from vla_eval.tasks.memory_env import nearness
from vla_eval.tasks.streams import Stream

JITTER_STD_M = 0.01
MIN_DISTANCE_M = 0.06
MAX_JITTER_TRIES = 50
MIXED_MIN_DISTANCE_M = 0.061  # a cross is 6 cm wide
SHAPE_COLOR = COLORS[2]  # blue, as in the official RememberShape
MIXED_SHAPES = ("cube", "sphere", "t_shape", "cross", "torus")
MIXED_COLORS = COLORS[:3]
# The official arc is squeezed in y by so much per place, for these numbers of items only.
SQUEEZE_M = {5: 0.025, 9: 0.025}

Plane = NDArray[np.float64]
"""Positions in the table's plane, (…, 2), m."""


def slot_centres_m(n_items: int) -> Plane:
    """Return (N, 2) xy of the places on the table, world frame, before jitter.

    A row for three items, otherwise an arc around the robot. Source: official task code, constants as
    measured in the task table of `docs/tasks.md`; numbers of items that it does not have follow the same
    rule with the squeeze of five and nine.
    """
    if n_items == 3:
        return np.array([[0.0, 0.1], [0.0, 0.0], [0.0, -0.1]])
    official_without_squeeze = n_items in (6, 15)
    squeeze_m = 0.0 if official_without_squeeze else SQUEEZE_M.get(n_items, 0.025)
    offset = 0.5 if n_items == 6 else 0.0
    ranks = [k - n_items // 2 + offset for k in range(n_items)]
    angles = [math.pi * rank / n_items for rank in ranks]
    return np.array(
        [
            (0.3 * math.cos(angle) - 0.25, 0.3 * math.sin(angle) - squeeze_m * rank)
            for rank, angle in zip(ranks, angles, strict=True)
        ]
    )


def jittered(centres_m: Plane, rng: np.random.Generator) -> Plane:
    """Shift each place by N(0, 1 cm) in x and y, one after another, at least 6 cm from those before.

    A place for which `MAX_JITTER_TRIES` draws fail stays where it is, as in the official code.
    """
    placed: list[Plane] = []
    for centre in centres_m:
        for _ in range(MAX_JITTER_TRIES):
            draft = centre + rng.normal(0, JITTER_STD_M, 2)
            if all(np.linalg.norm(draft - other) >= MIN_DISTANCE_M for other in placed):
                break
        else:
            draft = centre
        placed.append(draft)
    return np.stack(placed)


def jittered_apart(centres_m: Plane, rng: np.random.Generator) -> Plane:
    """Shift each place by N(0, 1 cm), at least 6.1 cm from all others, shifted already or still to come.

    So no two items ever overlap. The official code shifts all at once and keeps the best of 20 draws; of
    its 15 places some then lie 4.7 cm apart, and items 6 cm wide are thrown off when they are revealed
    (measured: by up to 10 cm).
    """
    places = centres_m.copy()
    for index, centre in enumerate(centres_m):
        others = np.delete(places, index, axis=0)
        for _ in range(MAX_JITTER_TRIES):
            draft = centre + rng.normal(0, JITTER_STD_M, 2)
            if np.linalg.norm(others - draft, axis=1).min() >= MIXED_MIN_DISTANCE_M:
                places[index] = draft
                break
    return places


class RememberEnv(ChoiceEnv):
    """Find the item that was shown before.

    Description: an item lies in the middle of the table (cue), then the table is empty (delay), then N
    items, that one among them, lie at N places in random order (response).

    The families below say which items there are. Everything else is the same:

    Action space: ManiSkill's, by `control_mode`; the harness uses `pd_ee_delta_pose`.

    Observation space: ManiSkill's `rgb` (`agent/qpos`, `agent/qvel`, `extra/tcp_pose`, two cameras) or
    `state` (besides: the oracle's numbers, and 3 per item, its position if it is the right one, else 0).

    Rewards: dense: reach 1 + slow down 0.5 + stand still 0.5, or 3 where solved; see `docs/tasks.md`.

    Starting state: arm at rest with joint noise of 0.02 rad; item uniform; places permuted uniformly.

    Episode end: 60 control steps; success and failure are reported but end nothing by themselves.

    Chance level: 1 / N for a perfect arm that ignores the cue.

    Version history: 1, first version.
    """

    MAX_REWARD = 3.0
    REACH_SCALE_PER_M = 10.0
    SLOWING_WEIGHT = 0.5
    RESTING_WEIGHT = 0.5

    def __init__(
        self, *args: Any, items: tuple[Item, ...], goal_threshold_m: float = 0.05, **kwargs: Any
    ) -> None:
        """Take the items and build the scene."""
        self.items = items
        super().__init__(*args, goal_threshold_m=goal_threshold_m, **kwargs)

    @property
    def n_items(self) -> int:
        """How many items there are to choose among."""
        return len(self.items)

    def stream_key(self) -> tuple[int, ...]:
        """Return the family's number and how many items there are."""
        return (self.FAMILY, self.n_items)

    def _load_items(self) -> None:
        self.candidates = [
            build_item(self.scene, item, initial_pose=self._parking_pose(item)) for item in self.items
        ]

    def _parking_pose(self, item: Item) -> sapien.Pose:
        return self.parking_pose(item.name, half_height_m=item.shape.rest_height_m)

    def _sample_episode(self, env: int) -> None:
        self._target[env] = int(self.episode_generator(env, Stream.TARGET).integers(self.n_items))
        places = self._places_m(self.episode_generator(env, Stream.LAYOUT))
        order = self.episode_generator(env, Stream.PERMUTATION).permutation(self.n_items)
        self._slots[env, :, :2] = torch.as_tensor(places[order], dtype=torch.float32)
        heights = [item.shape.rest_height_m for item in self.items]
        self._slots[env, :, 2] = torch.tensor(heights)

    def _places_m(self, rng: np.random.Generator) -> Plane:
        """Draw the (N, 2) places of one episode."""
        return jittered(slot_centres_m(self.n_items), rng)

    def _on_episode_start(self, mask: torch.Tensor) -> None:
        super()._on_episode_start(mask)
        self._park_all(mask)

    def _park_all(self, mask: torch.Tensor) -> None:
        for item, actor in zip(self.items, self.candidates, strict=True):
            self.move(actor, mask, self._parking_pose(item))

    def _on_phase_edges(self, step: torch.Tensor, mask: torch.Tensor) -> bool:
        cue_begins = mask & (step == 0) & (self._cue_end_step > 0)
        cue_ends = mask & (step == self._cue_end_step) & (step > 0)
        choice_begins = mask & (step == self._response_step)
        for index, (item, actor) in enumerate(zip(self.items, self.candidates, strict=True)):
            shown = cue_begins & (self._target == index)
            self.move(actor, shown, sapien.Pose(p=[0, 0, item.shape.rest_height_m]))
        self._park_all(cue_ends)
        self.reveal(choice_begins, torch.tensor([1.0, 0.0, 0.0, 0.0], device=self.device))
        return bool((cue_begins | cue_ends | choice_begins).any())

    def reward_terms(self, info: dict[str, Any]) -> dict[str, torch.Tensor]:
        """As in `ChoiceEnv`, but slowing down is rewarded everywhere (official code)."""
        terms = super().reward_terms(info)
        terms["slowing"] = self.SLOWING_WEIGHT * nearness(5.0, self.arm_speed())
        return terms

    def _privileged_extra(self) -> dict[str, torch.Tensor]:
        positions = self.candidate_positions_m()
        extra = {"oracle_info": self.oracle_info()}
        for index in range(self.n_items):
            is_target = (self._target == index)[:, None]
            extra[f"goal_{index}_pose"] = torch.where(is_target, positions[:, index], 0.0)
        return extra


class RememberColorEnv(RememberEnv):
    """RememberColor: find the cube that has the colour shown before; see `RememberEnv`.

    Arguments: `n_items` 2 to 9, and those of `RememberEnv`, `ChoiceEnv` and `MemoryTableEnv`.
    """

    FAMILY = 1

    def __init__(self, *args: Any, n_items: int = 3, **kwargs: Any) -> None:
        """Check the number of colours."""
        _check_count("n_items", n_items, len(COLORS), "colour")
        cube = SHAPES["cube"]
        super().__init__(*args, items=tuple(Item(cube, color) for color in COLORS[:n_items]), **kwargs)


class RememberShapeEnv(RememberEnv):
    """RememberShape: find the blue item that has the shape shown before; see `RememberEnv`.

    Arguments: `n_items` 2 to 9, and those of `RememberEnv`, `ChoiceEnv` and `MemoryTableEnv`.
    """

    FAMILY = 4

    def __init__(self, *args: Any, n_items: int = 3, **kwargs: Any) -> None:
        """Check the number of shapes."""
        _check_count("n_items", n_items, len(SHAPES), "shape")
        shapes = list(SHAPES.values())[:n_items]
        super().__init__(*args, items=tuple(Item(shape, SHAPE_COLOR) for shape in shapes), **kwargs)


class RememberShapeAndColorEnv(RememberEnv):
    """RememberShapeAndColor: find the item that has shape and colour shown before; see `RememberEnv`.

    Arguments: `n_shapes` 1 to 5, `n_colors` 1 to 3, `official_3x2` (two shapes in three colours, as the
    official code has it under the name of three shapes in two colours), and those of the base classes.
    """

    FAMILY = 5

    def __init__(
        self, *args: Any, n_shapes: int = 3, n_colors: int = 2, official_3x2: bool = False, **kwargs: Any
    ) -> None:
        """Check the numbers of shapes and colours."""
        _check_count("n_shapes", n_shapes, len(MIXED_SHAPES), "shape", least=1)
        _check_count("n_colors", n_colors, len(MIXED_COLORS), "colour", least=1)
        if n_shapes * n_colors < 2:
            raise TaskArgumentError("n_shapes × n_colors is 1: expected at least two items to choose among.")
        if official_3x2:
            if (n_shapes, n_colors) != (3, 2):
                raise TaskArgumentError(
                    f"official_3x2 with n_shapes={n_shapes}, n_colors={n_colors}: it swaps 3 and 2 only."
                )
            n_shapes, n_colors = 2, 3
        self.n_shapes, self.n_colors = n_shapes, n_colors
        items = [Item(SHAPES[s], color) for s in MIXED_SHAPES[:n_shapes] for color in MIXED_COLORS[:n_colors]]
        super().__init__(*args, items=tuple(items), **kwargs)

    def stream_key(self) -> tuple[int, ...]:
        """Return the family's number and how many shapes and colours there are."""
        return (self.FAMILY, self.n_shapes, self.n_colors)

    def _places_m(self, rng: np.random.Generator) -> Plane:
        return jittered_apart(slot_centres_m(self.n_items), rng)

    def oracle_info(self) -> torch.Tensor:
        """Return (B, 2) uint8: the right shape's and the right colour's number."""
        shape, color = self._target // self.n_colors, self._target % self.n_colors
        return torch.stack([shape, color], dim=1).to(torch.uint8)


def _check_count(name: str, count: Any, most: int, what: str, *, least: int = 2) -> None:
    if not isinstance(count, int) or isinstance(count, bool) or not least <= count <= most:
        raise TaskArgumentError(f"{name}={count!r}: expected {least} to {most}, one per {what}.")
