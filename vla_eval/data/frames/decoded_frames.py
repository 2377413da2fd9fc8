"""A `LeRobotDataset` that decodes each frame once: the same samples, without video decoding per sample.

lerobot decodes video for every sample of every epoch. Frames of 128×128 are small: 5000 of two cameras
take 470 MiB, which a memory map serves from the page cache to any number of loader processes.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, get_args  # Any: lerobot, datasets and pyarrow are untyped

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from vla_eval.core import ImageArray
from vla_eval.data.frames.frame_cache import frame_source, frames_in_ram, frames_on_disk
from vla_eval.data.tables import as_array, holds_numbers
from vla_eval.errors import DatasetError, check_names
from vla_eval.features import REWARD_KEY, SUCCESS_KEY, RewardKind
from vla_eval.models.shared.images import in_numbers
from vla_eval.strict.decoding import warn_renamed

Storage = Literal["disk", "ram"]
Sample = dict[str, Any]  # Any: tensors, and the task's sentence
OF_SOURCE = ("num_episodes", "features", "fps", "hf_dataset", "absolute_to_relative_idx")
TENSOR_TYPES = {"b": np.bool_, "i": np.int64, "u": np.int64, "f": np.float32}


class DecodedFramesDataset(torch.utils.data.Dataset[Sample]):
    """Serves what `source[i]` serves, bit for bit, from decoded frames.

    Chunks (`delta_timestamps`), `*_is_pad`, `episodes`, `image_transforms` and `return_uint8` are those
    of the source. It has the attributes that lerobot's training loop reads of a dataset.

    Args:
        source: a dataset that can be read.
        storage: `disk` keeps the frames in a memory-mapped file in the user's cache; `ram` in this process
            (loader processes share them), for machines whose disk is smaller than their RAM. The old name
            `memory` still means `ram`, with a warning.
        cache: the folder for decoded frames; by default in the user's cache.
        whole_episodes: serve for each frame the sample of its episode's last frame. For policies with a
            memory, whose window reaches back to the beginning: a window that ends in the middle is a part
            of the same sample.
        reward: what `next.reward` is, see `rewards_of`; None: as the table has it, if it has it.

    Raises:
        DatasetError: cameras that are not videos, a damaged file, no rewards of that kind, or no room for the
            frames.
        UnknownNameError: `delta_timestamps` names a field that is not there, or `storage` is another word.
    """

    def __init__(
        self,
        source: LeRobotDataset,
        *,
        storage: Storage | Literal["memory"] = "disk",
        cache: Path | None = None,
        whole_episodes: bool = False,
        reward: RewardKind | None = None,
    ) -> None:
        if storage == "memory":
            warn_renamed("storage='memory'", "storage='ram'")
            storage = "ram"
        check_names("storage", [storage], get_args(Storage), where="DecodedFramesDataset")
        reader = source._ensure_reader()
        self.source, self._whole_episodes = source, whole_episodes
        self.meta, self.episodes = source.meta, source.episodes
        self._deltas: Mapping[str, list[int]] | None = reader.delta_indices
        self._transforms: Callable[[Any], Any] | None = reader._image_transforms
        self._return_uint8 = bool(reader._return_uint8)
        self._columns = _columns(source)
        check_names("field", self._deltas or (), source.meta.features, where="delta_timestamps")
        frames = frame_source(source, self._columns)
        rows = [(one.first, one.stop) for one in frames.episodes for _ in one.timestamps_s]
        self._bounds = torch.tensor(rows, dtype=torch.long).reshape(-1, 2)  # of each sample's episode
        if reward is not None:
            rewards = rewards_of(self._columns, self._bounds, reward, root=source.root)
            self._columns[REWARD_KEY] = rewards
        self._files: dict[str, Path] = {}
        self._frames: dict[str, Any] = {}  # Any: a memory map, or a tensor that processes can share
        if storage == "disk":
            self._files = frames_on_disk(frames, cache)
            self._open()
        else:
            arrays = frames_in_ram(frames)
            self._frames = {camera: torch.from_numpy(array) for camera, array in arrays.items()}

    @property
    def num_frames(self) -> int:
        """Number of samples."""
        return int(self._bounds.shape[0])

    def __getattr__(self, name: str) -> Any:
        """Return what lerobot's training loop reads of a dataset, too."""
        if name not in OF_SOURCE:
            raise AttributeError(f"{type(self).__name__} has no attribute '{name}'")
        return getattr(self.source, name)

    def __len__(self) -> int:
        return self.num_frames

    def __getitem__(self, index: int) -> Sample:
        """Return one sample; every tensor in it is a new one."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        index = self.served(index % len(self))
        fields = {
            key: column[index].clone() if isinstance(column, torch.Tensor) else column[index]
            for key, column in self._columns.items()
        }
        # Field -> rows, those beyond the episode replaced by its ends, and which ones were.
        first, stop = self._bounds[index].tolist()
        rows, padding = {}, {}
        for key, deltas in (self._deltas or {}).items():
            wanted = [index + delta for delta in deltas]
            rows[key] = [max(first, min(stop - 1, row)) for row in wanted]
            padding[f"{key}_is_pad"] = torch.tensor([not first <= row < stop for row in wanted])
        fields |= padding
        for key, chosen in rows.items():
            if key not in self._frames:
                fields[key] = self._columns[key][chosen]
        sample = {**self._images(index, rows), **fields}
        sample["task"] = self.meta.tasks.iloc[fields["task_index"].item()].name
        return sample

    def served(self, index: int) -> int:
        """Return which of the source's samples a sample is; another one only with `whole_episodes`."""
        return int(self._bounds[index, 1]) - 1 if self._whole_episodes else index

    def __getstate__(self) -> dict[str, Any]:
        """Leave mapped files behind: another process maps them itself."""
        return {**self.__dict__, "_frames": {} if self._files else self._frames}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if self._files:
            self._open()

    def _open(self) -> None:
        for camera, path in self._files.items():
            frames: ImageArray = np.load(path, mmap_mode="r", allow_pickle=False)
            if len(frames) != len(self):
                raise DatasetError(
                    f"{path}: holds {len(frames)} frames, expected {len(self)}. Delete the folder "
                    f"{path.parent}: it is made again."
                )
            self._frames[camera] = frames

    def _images(self, index: int, rows: Mapping[str, list[int]]) -> Sample:
        """Return the images of a sample by field; `rows` has those of fields with an axis of time."""
        return {camera: self._image(camera, rows.get(camera, [index])) for camera in self._frames}

    def _image(self, camera: str, rows: list[int]) -> torch.Tensor:
        taken = self._frames[camera][rows]  # a list of rows copies
        frames = torch.from_numpy(taken) if isinstance(taken, np.ndarray) else taken
        frames = frames.squeeze(0)
        frames = frames if self._return_uint8 else in_numbers(frames)
        return frames if self._transforms is None else self._transforms(frames)


def _columns(source: LeRobotDataset) -> dict[str, Any]:
    """Return column -> a tensor with one row per frame, or the list of values if no numbers."""
    refused = [key for key in source.meta.camera_keys if key not in source.meta.video_keys]
    refused += list(source.meta.depth_keys)
    if refused:
        raise DatasetError(
            f"{source.root}: the cameras {', '.join(refused)} are not RGB videos. Only those are decoded "
            f"ahead; use lerobot's own loader for this dataset."
        )
    table = source.hf_dataset.with_format("arrow")[:]
    return {name: _tensor(table[name]) for name in table.column_names}


def _tensor(column: Any) -> Any:  # Any: pyarrow.ChunkedArray; a tensor, or a list
    if not holds_numbers(column):
        return column.to_pylist()
    values = as_array(column)
    return torch.from_numpy(np.array(values, dtype=TENSOR_TYPES[values.dtype.kind]))


def rewards_of(
    columns: Mapping[str, Any], bounds: torch.Tensor, kind: RewardKind, *, root: Path
) -> torch.Tensor:
    """Return the reward of each row, (N,) float32.

    Args:
        columns: field -> (N, …).
        bounds: (N, 2) first and stop row of each row's episode.
        kind: `dense`: the table's; `sparse`: 1 where the success rule holds for the first time in the
            episode, else 0, so that the sum over an episode is whether it succeeded once; `success`: 1
            wherever it holds.
        root: the dataset's folder, for messages.
    """
    key = REWARD_KEY if kind == "dense" else SUCCESS_KEY
    if key not in columns:
        raise DatasetError(
            f"{root}: has no field '{key}', which `reward: {kind}` is read from. Use a dataset with rewards "
            "(`mikasa-vla record` stores them), or a policy that reads none."
        )
    values: torch.Tensor = columns[key].reshape(-1).float()
    if kind != "sparse":
        return values
    n_so_far = values.cumsum(0)
    n_before_episode = n_so_far[bounds[:, 0]] - values[bounds[:, 0]]
    return values * (n_so_far - n_before_episode == 1)
