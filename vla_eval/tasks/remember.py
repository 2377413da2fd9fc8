"""RememberColor: a cube is shown, hidden, and must be recognised by its colour among others."""

import math
from typing import Any, NamedTuple

import numpy as np
import sapien
import torch
from mani_skill.utils.building import actors
from numpy.typing import NDArray

from vla_eval.errors import TaskArgumentError
from vla_eval.tasks.choice import ChoiceEnv
from vla_eval.tasks.memory_env import nearness
from vla_eval.tasks.streams import Stream

CUBE_HALF_SIZE_M = 0.02
CUE_POSITION_M = (0.0, 0.0, CUBE_HALF_SIZE_M)
JITTER_STD_M = 0.01
MIN_DISTANCE_M = 0.06
MAX_JITTER_TRIES = 50

Plane = NDArray[np.float64]
"""Positions in the table's plane, (…, 2), m."""


class NamedColor(NamedTuple):
    """A colour that is called what it looks like."""

    name: str
    rgb: tuple[int, int, int]


# Values and order of the official code, which calls (0, 255, 0) "Lime" and (255, 128, 0) "Olive".
COLORS = (
    NamedColor("red", (255, 0, 0)),
    NamedColor("green", (0, 255, 0)),
    NamedColor("blue", (0, 0, 255)),
    NamedColor("yellow", (255, 255, 0)),
    NamedColor("magenta", (255, 0, 255)),
    NamedColor("cyan", (0, 255, 255)),
    NamedColor("maroon", (128, 0, 0)),
    NamedColor("orange", (255, 128, 0)),
    NamedColor("teal", (0, 128, 128)),
)


def slot_centres_m(n_items: int) -> Plane:
    """Return (N, 2) xy of the places on the table, world frame, before jitter.

    A row for three items, otherwise an arc around the robot. Source: official task code, constants as
    measured in the task table of `docs/tasks.md`.
    """
    if n_items == 3:
        return np.array([[0.0, 0.1], [0.0, 0.0], [0.0, -0.1]])
    centre = n_items // 2
    angles = [math.pi * (k - centre) / n_items for k in range(n_items)]
    return np.array(
        [
            (0.3 * math.cos(angle) - 0.25, 0.3 * math.sin(angle) - 0.025 * (k - centre))
            for k, angle in enumerate(angles)
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


class RememberColorEnv(ChoiceEnv):
    """RememberColor: find the cube that has the colour shown before.

    Description: a cube of one colour lies in the middle of the table (cue), then the table is empty
    (delay), then N cubes of different colours lie at N places in random order (response).

    Action space: ManiSkill's, by `control_mode`; the harness uses `pd_ee_delta_pose`.

    Observation space: ManiSkill's `rgb` (`agent/qpos`, `agent/qvel`, `extra/tcp_pose`, two cameras) or
    `state` (besides: oracle 1, and 3 numbers per cube, its position if it is the right one, else 0).

    Rewards: dense: reach 1 + slow down 0.5 + stand still 0.5, or 3 where solved; see `docs/tasks.md`.

    Starting state: arm at rest with joint noise of 0.02 rad; colour uniform; places permuted uniformly.

    Episode end: 60 control steps; success and failure are reported but end nothing by themselves.

    Arguments: `n_items` 2 to 9, and those of `ChoiceEnv` and `MemoryTableEnv`.

    Chance level: 1 / `n_items` for a perfect arm that ignores the cue.

    Version history: 1, first version.
    """

    MAX_REWARD = 3.0
    FAMILY = 1
    REACH_SCALE_PER_M = 10.0
    SLOWING_WEIGHT = 0.5
    RESTING_WEIGHT = 0.5

    def __init__(self, *args: Any, n_items: int = 3, goal_threshold_m: float = 0.05, **kwargs: Any) -> None:
        """Check the number of items and build the scene."""
        if not isinstance(n_items, int) or not 2 <= n_items <= len(COLORS):
            raise TaskArgumentError(f"n_items={n_items!r}: expected 2 to {len(COLORS)}, one per colour.")
        self.n_items = n_items
        super().__init__(*args, goal_threshold_m=goal_threshold_m, **kwargs)

    def stream_key(self) -> tuple[int, ...]:
        """Return the family's number and how many items there are."""
        return (self.FAMILY, self.n_items)

    def _load_items(self) -> None:
        self.candidates = [
            actors.build_cube(
                self.scene,
                half_size=CUBE_HALF_SIZE_M,
                color=[*(channel / 255 for channel in color.rgb), 1.0],
                name=f"cube_{color.name}",
                initial_pose=self.parking_pose(f"cube_{color.name}", half_height_m=CUBE_HALF_SIZE_M),
            )
            for color in COLORS[: self.n_items]
        ]

    def _sample_episode(self, env: int) -> None:
        self._target[env] = int(self.episode_generator(env, Stream.TARGET).integers(self.n_items))
        places = jittered(slot_centres_m(self.n_items), self.episode_generator(env, Stream.LAYOUT))
        order = self.episode_generator(env, Stream.PERMUTATION).permutation(self.n_items)
        self._slots[env, :, :2] = torch.as_tensor(places[order], dtype=torch.float32)
        self._slots[env, :, 2] = CUBE_HALF_SIZE_M

    def _on_episode_start(self, mask: torch.Tensor) -> None:
        super()._on_episode_start(mask)
        self._park_all(mask)

    def _park_all(self, mask: torch.Tensor) -> None:
        for actor in self.candidates:
            self.move(actor, mask, self.parking_pose(actor.name, half_height_m=CUBE_HALF_SIZE_M))

    def _on_phase_edges(self, step: torch.Tensor, mask: torch.Tensor) -> bool:
        cue_begins = mask & (step == 0) & (self._cue_end_step > 0)
        cue_ends = mask & (step == self._cue_end_step) & (step > 0)
        choice_begins = mask & (step == self._response_step)
        for index, actor in enumerate(self.candidates):
            shown = cue_begins & (self._target == index)
            self.move(actor, shown, sapien.Pose(p=CUE_POSITION_M))
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
