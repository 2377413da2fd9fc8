"""One demonstration as its source has it, whatever the layout. Nothing is made up."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from vla_eval.control_modes import EE_DELTA_POSE, JOINT_DELTA_POS, action_spec
from vla_eval.core import ImageArray
from vla_eval.data.checks.demonstrated import Demonstrations, Numbers
from vla_eval.errors import DatasetError
from vla_eval.features import ACTION_KEY, DONE_KEY, PROPRIO_KEYS, REWARD_KEY, STATE_NAMES, SUCCESS_KEY
from vla_eval.specs import ActionSpec

Layout = Literal["npz_joints", "npz_proprio", "lerobot_mikasa", "lerobot_official", "lerobot_suite90"]
CameraImages = tuple[ImageArray, ImageArray]
"""Base and wrist camera: (T, H, W, 3) uint8 RGB."""

SOURCE_MODES = {7: EE_DELTA_POSE, 8: JOINT_DELTA_POS}
"""Length of an action -> the control mode it is for, as the authors' two recorders write them."""
JOINTS_KEY, EEF_KEY = PROPRIO_KEYS["joints"], PROPRIO_KEYS["eef"]
SOURCE_PROPRIO_KEY = "proprio.xyz_rpy"
NUMBER_NAMES: Mapping[str, tuple[str, ...]] = {
    JOINTS_KEY: STATE_NAMES["joints"],
    EEF_KEY: STATE_NAMES["eef"],
    SOURCE_PROPRIO_KEY: ("x", "y", "z", "roll", "pitch", "yaw", "gripper_width"),
    REWARD_KEY: ("reward",),
    SUCCESS_KEY: ("success",),
    DONE_KEY: ("done",),
}
"""Field -> its numbers. A source has the action, and at least one of the first three."""
PER_STEP = (REWARD_KEY, SUCCESS_KEY, DONE_KEY)
"""Fields that say what an action led to."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceEpisode:
    """One demonstration as its source has it."""

    name: str
    numbers: Mapping[str, Numbers]  # field, by our name -> (T,) or (T, D), in the source's type
    # (T,) the language instruction at each frame; None if the source has none
    sentences: tuple[str | None, ...]
    # height and width of the base and the wrist camera
    image_sizes_px: tuple[tuple[int, int], tuple[int, int]]
    read_images: Callable[[], CameraImages]  # decodes them; raises `DatasetError`
    seed: int | None = None  # the episode's seed in the source's environment (not in ours)

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.numbers[ACTION_KEY])


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Demonstrations that were found; one or more episodes, which all have the same numbers."""

    path: Path
    layout: Layout  # see docs/dataset_tools.md
    files: Sequence[Path]  # what they were read from
    fps: float
    episodes: tuple[SourceEpisode, ...]
    left_out: tuple[str, ...] = ()  # fields of the source that have no place in ours
    remarks: tuple[str, ...] = ()  # what was assumed

    def __post_init__(self) -> None:
        first = self.episodes[0]
        for episode in self.episodes[1:]:
            differing = set(first.numbers) ^ set(episode.numbers) or {
                name
                for name, rows in first.numbers.items()
                if rows.shape[1:] != episode.numbers[name].shape[1:]
            }
            if differing:
                raise DatasetError(
                    f"{self.path}: {episode.name} differs from the episodes before it in "
                    f"{', '.join(sorted(differing))}; one dataset has the same fields everywhere. Convert "
                    "them apart."
                )

    @property
    def action(self) -> ActionSpec:
        """What the actions are for."""
        return action_spec(SOURCE_MODES[self.episodes[0].numbers[ACTION_KEY].shape[1]])

    def demonstrations(self, *, expected_px: int) -> Demonstrations:
        """Return what is checked of the episodes."""
        names = self.episodes[0].numbers
        cameras = ("base camera", "wrist camera")
        sizes = dict(zip(cameras, self.episodes[0].image_sizes_px, strict=True))
        for episode in self.episodes:
            if episode.image_sizes_px != self.episodes[0].image_sizes_px:
                sizes |= {
                    f"{camera} of {episode.name}": size
                    for camera, size in zip(cameras, episode.image_sizes_px, strict=True)
                }
                break
        return Demonstrations(
            where=self.path,
            fps=self.fps,
            names=tuple(episode.name for episode in self.episodes),
            lengths=tuple(episode.n_frames for episode in self.episodes),
            columns={
                name: np.concatenate([episode.numbers[name] for episode in self.episodes]) for name in names
            },
            dims={**{name: NUMBER_NAMES[name] for name in names if name in NUMBER_NAMES}}
            | {ACTION_KEY: self.action.dims},
            sentences=tuple(sentence for episode in self.episodes for sentence in episode.sentences),
            action=self.action,
            image_sizes_px=sizes,
            expected_px=expected_px,
        )
