"""What is checked: the numbers and sentences of demonstrations, in one form for every layout. No images."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vla_eval.specs import ActionSpec

Numbers = NDArray[np.generic]


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """The numbers and sentences of all episodes, frame after frame."""

    where: Path
    fps: float
    names: tuple[str, ...]
    lengths: tuple[int, ...]
    columns: Mapping[str, Numbers]  # field -> (N,) or (N, D) numbers
    # field -> the names of its D numbers; a field is absent if they are not known
    dims: Mapping[str, tuple[str, ...]]
    # (N,) the language instruction of each frame, None if there is none; or empty, if what is made of
    # them has none
    sentences: tuple[str | None, ...]
    action: ActionSpec | None  # what the actions are for; None if that is not known
    image_sizes_px: Mapping[str, tuple[int, int]]  # camera -> height and width
    # height and width that images shall have; None: any, if it is the same for all
    expected_px: int | None = None
    # whether they are of an arm that LeRobot drives: its rate and its cameras are its own
    of_an_arm: bool = False
    is_gripper_named: bool = False  # whether the user has said what the gripper's commands mean

    @property
    def n_frames(self) -> int:
        """Of all episodes."""
        return sum(self.lengths)

    @cached_property
    def firsts(self) -> NDArray[np.int64]:
        """(E,) row of each episode's first frame."""
        return np.cumsum([0, *self.lengths[:-1]], dtype=np.int64)

    def place(self, row: int) -> str:
        """Return `episode 3, frame 12` for a row."""
        episode = int(np.searchsorted(self.firsts, row, side="right")) - 1
        while not self.lengths[episode]:  # episodes without a frame begin where the next one does
            episode -= 1
        return f"{self.names[episode]}, frame {row - int(self.firsts[episode])}"

    def floats(self, name: str) -> NDArray[np.float64]:
        """Return a field as (N, D) float64."""
        rows = self.columns[name]
        return rows.reshape(self.n_frames, int(np.prod(rows.shape[1:]))).astype(np.float64)

    def dim(self, name: str, index: int) -> str:
        """Return `action (gripper)` for a number of a field."""
        names = self.dims.get(name, ())
        if len(names) == 1:
            return name
        return f"{name} ({names[index] if index < len(names) else index})"
