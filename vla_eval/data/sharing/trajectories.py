"""The paper's layout for offline reinforcement learning, read from a dataset of ours: a view, not a copy.

One episode is what one of the authors' files holds: `rgb (T, H, W, 6)`, `joints (T, 25)`, `action (T, A)`,
`reward`, `success`, `done` (T,). Source: the paper's appendix on datasets, and the recorder that wrote them,
https://github.com/CognitiveAISystems/MIKASA-Robo/blob/2350fa6/mikasa_robo_suite/dataset_collectors/
get_mikasa_robo_datasets.py. Knows nothing of policies.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import FloatArray, ImageArray
from vla_eval.data.frames.frame_cache import frame_source, frames_on_disk
from vla_eval.data.opening import open_dataset
from vla_eval.errors import DatasetError, did_you_mean
from vla_eval.features import (
    ACTION_KEY,
    CAMERA_KEYS,
    DONE_KEY,
    PROPRIO_KEYS,
    REWARD_KEY,
    SUCCESS_KEY,
    RewardKind,
)

FIELDS = (PROPRIO_KEYS["joints"], ACTION_KEY, REWARD_KEY, SUCCESS_KEY, DONE_KEY)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """One episode of T steps; a step's reward, success and done are what its action led to.

    Attributes:
        rgb_THWC: uint8, base camera, then wrist camera, as six channels.
        joints_TD: (T, 25) pose of the tool centre point, joint positions, joint velocities.
        actions_TA: in the dataset's control mode.
        dense_rewards_T: the task's dense reward, divided by its value at success.
        success_T, done_T: bool; done in the last step alone.
    """

    rgb_THWC: ImageArray  # shape suffix
    joints_TD: FloatArray
    actions_TA: FloatArray
    dense_rewards_T: FloatArray
    success_T: NDArray[np.bool_]
    done_T: NDArray[np.bool_]

    @property
    def succeeds(self) -> bool:
        """Whether the success rule held at some step."""
        return bool(self.success_T.any())

    def rewards(self, kind: RewardKind) -> FloatArray:
        """Return (T,) float32; the paper's code calls `success` sparse."""
        if kind == "dense":
            return self.dense_rewards_T.copy()
        counts = self.success_T if kind == "success" else self.success_T & (self.success_T.cumsum() == 1)
        return counts.astype(np.float32)

    def returns_to_go(self, kind: RewardKind, *, discount: float = 1.0) -> FloatArray:
        """Return (T,) float32: the sum of a step's reward and all later ones.

        Args:
            kind: of the rewards.
            discount: by which a reward counts less for each step that it is away.
        """
        returns, after = np.zeros(len(self.success_T), dtype=np.float64), 0.0
        rewards = self.rewards(kind)
        for step in reversed(range(len(rewards))):
            after = float(rewards[step]) + discount * after
            returns[step] = after
        return returns.astype(np.float32)

    def arrays(self) -> dict[str, NDArray[Any]]:  # Any: arrays of several types
        """Return the arrays of the paper's files by their names and types; `np.savez` takes them."""
        return {
            "rgb": self.rgb_THWC,
            "joints": self.joints_TD,
            "action": self.actions_TA,
            "reward": self.dense_rewards_T,
            "success": self.success_T.astype(np.int64),
            "done": self.done_T.astype(np.int64),
        }


class Trajectories(Sequence[Trajectory]):
    """The episodes of a complete dataset, in their order; each is read when it is asked for.

    Images are decoded once, into the user's cache, where training finds them, too.

    Args:
        root: the folder of a dataset.
        cache: where decoded frames lie; by default in the user's cache.

    Raises:
        DatasetError: it is not complete, or lacks a field of the layout.
    """

    def __init__(self, root: Path, *, cache: Path | None = None) -> None:
        dataset = open_dataset(root)
        for name in (*CAMERA_KEYS.values(), *FIELDS):
            if name not in dataset.meta.features:
                known = dataset.meta.features
                raise DatasetError(
                    f"{root}: expected the field '{name}', found {', '.join(known)}."
                    f"{did_you_mean(name, known)} Imported data may lack rewards; a recording has all fields."
                )
        self._columns: dict[str, Any] = {name: dataset.columns[name] for name in FIELDS}  # arrays of types
        frames = frame_source(dataset.local.whole, dataset.columns)
        self._episodes = frames.episodes
        files = frames_on_disk(frames, cache)
        self._frames: list[ImageArray] = [
            np.load(files[name], mmap_mode="r", allow_pickle=False) for name in CAMERA_KEYS.values()
        ]

    def __len__(self) -> int:
        return len(self._episodes)

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[index] for index in range(len(self)))

    @overload
    def __getitem__(self, index: int) -> Trajectory: ...
    @overload
    def __getitem__(self, index: slice) -> list[Trajectory]: ...

    def __getitem__(self, index: int | slice) -> Trajectory | list[Trajectory]:
        """Return an episode, or several; every array is a new one."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        rows = slice(self._episodes[index].first, self._episodes[index].stop)
        joints, action, reward, success, done = (self._columns[name][rows].copy() for name in FIELDS)
        rgb_TCHW = np.concatenate([frames[rows] for frames in self._frames], axis=1)
        return Trajectory(
            rgb_THWC=np.ascontiguousarray(rgb_TCHW.transpose(0, 2, 3, 1)),
            joints_TD=joints,
            actions_TA=action,
            dense_rewards_T=reward,
            success_T=success,
            done_T=done,
        )
