"""Read demonstrations in the layouts they are found in; nothing that a source does not hold is made up.

- `npz`, one file per episode, as the paper's recordings have it: `rgb (T, 128, 128, 6)` uint8 base camera,
  then wrist camera; `joints (T, 25)`; `action (T, 7 or 8)`; `reward`, `success`, `done` (T,).
- `npz`, as the authors' later recordings for vision-language-action models have it: instead of `joints`,
  `proprio (T, 7)`, position, roll, pitch, yaw, gripper width; besides `language_instruction`, `episode_seed`.
- `lerobot`, ours, or the authors' releases: with `observation.image` and `observation.wrist_image`, or, of
  their 90 tasks, with `observation.images.top` and `observation.images.wrist`.

Files are never unpickled.
"""

import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from vla_eval.control_modes import EE_DELTA_POSE, JOINT_DELTA_POS
from vla_eval.core import FloatArray, ImageArray
from vla_eval.errors import DatasetError, did_you_mean
from vla_eval.features import IMAGE_SHAPE

Layout = Literal["npz_joints", "npz_proprio", "lerobot_mikasa", "lerobot_official", "lerobot_suite90"]

N_JOINT_NUMBERS = 25  # pose of the tool centre point 7, joint positions 9, joint velocities 9
N_PROPRIO_NUMBERS = 7  # position 3, roll, pitch, yaw, gripper width
SOURCE_MODES = {7: EE_DELTA_POSE, 8: JOINT_DELTA_POS}
"""Length of an action -> the control mode it is for, as the authors' two recorders write them."""

NPZ_NEEDED = ("rgb", "action")
NPZ_PER_FRAME = ("reward", "success", "done")
NPZ_SINGLE = ("language_instruction", "episode_seed")
NPZ_KNOWN = (*NPZ_NEEDED, "joints", "proprio", *NPZ_PER_FRAME, *NPZ_SINGLE)


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceEpisode:
    """One demonstration as its source has it; None is what the source does not have.

    Attributes:
        name: for messages and records: a file's name, or the episode's number.
        images_base_THWC, images_wrist_THWC: uint8 RGB.
        actions_TA: float32; A is 7 for end-effector deltas, 8 for joint deltas.
        joints_TD: float32 (T, 25).
        proprio_TD: float32 (T, 7).
        rewards_T: float32.
        success_T, done_T: bool.
        instruction: the language instruction.
        seed: the episode's seed in the source's environment (not in ours).
    """

    name: str
    images_base_THWC: ImageArray  # shape suffix
    images_wrist_THWC: ImageArray
    actions_TA: FloatArray
    joints_TD: FloatArray | None = None
    proprio_TD: FloatArray | None = None
    rewards_T: FloatArray | None = None
    success_T: NDArray[np.bool_] | None = None
    done_T: NDArray[np.bool_] | None = None
    instruction: str | None = None
    seed: int | None = None

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.actions_TA)


@dataclass(slots=True, kw_only=True)
class Source:
    """Demonstrations that were found; reading them fills `left_out`."""

    path: Path
    layout: Layout
    files: Sequence[Path]
    left_out: set[str] = field(default_factory=set)

    def episodes(self) -> Iterator[SourceEpisode]:
        """Read one episode after another."""
        if self.layout.startswith("lerobot"):
            from vla_eval.data.opening import open_local_dataset

            yield from read_lerobot(open_local_dataset(self.path), self.layout)
            return
        for file in self.files:
            episode, unknown = read_npz(file)
            self.left_out.update(unknown)
            yield episode


def npz_files(folder: Path) -> list[Path]:
    """Return the npz files of a folder, `train_data_10.npz` after `train_data_9.npz`."""

    def key(path: Path) -> list[tuple[bool, int, str]]:
        parts = re.split(r"(\d+)", path.stem)
        return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts if part]

    return sorted(folder.glob("*.npz"), key=key)


def read_npz(path: Path) -> tuple[SourceEpisode, Sequence[str]]:
    """Read one episode, and the names of the arrays in the file that have no place in it.

    Raises:
        DatasetError: the file is damaged, holds pickled objects, or is of another layout.
    """
    arrays = _arrays(path)
    for name in NPZ_NEEDED:
        if name not in arrays:
            raise DatasetError(
                f"{path}: there is no '{name}'.{did_you_mean(name, arrays)} It has: {', '.join(arrays)}. "
                f"docs/dataset_tools.md lists the layouts that can be read."
            )
    if "joints" not in arrays and "proprio" not in arrays:
        raise DatasetError(f"{path}: there is neither 'joints' (T, 25) nor 'proprio' (T, 7).")
    actions = _numbers(path, arrays, "action", None)
    n_frames = len(actions)
    if actions.ndim != 2 or actions.shape[1] not in SOURCE_MODES:
        raise DatasetError(f"{path}: action is {actions.shape}, expected (T, 7) or (T, 8).")
    rgb = arrays["rgb"]
    shape = (n_frames, *IMAGE_SHAPE[:2], 6)
    if rgb.shape != shape or rgb.dtype != np.uint8:
        raise DatasetError(f"{path}: rgb is {rgb.shape} {rgb.dtype}, expected {shape} uint8.")
    episode = SourceEpisode(
        name=path.name,
        images_base_THWC=np.ascontiguousarray(rgb[..., :3]),
        images_wrist_THWC=np.ascontiguousarray(rgb[..., 3:]),
        actions_TA=actions,
        joints_TD=_optional(path, arrays, "joints", (n_frames, N_JOINT_NUMBERS)),
        proprio_TD=_optional(path, arrays, "proprio", (n_frames, N_PROPRIO_NUMBERS)),
        rewards_T=_optional(path, arrays, "reward", (n_frames,)),
        success_T=_flags(_optional(path, arrays, "success", (n_frames,))),
        done_T=_flags(_optional(path, arrays, "done", (n_frames,))),
        instruction=_sentence(path, arrays),
        seed=_seed(path, arrays),
    )
    return episode, [name for name in arrays if name not in NPZ_KNOWN]


def read_lerobot(dataset: Any, layout: Layout) -> Iterator[SourceEpisode]:  # Any: LeRobotDataset
    """Yield the episodes of an opened LeRobotDataset of one of the layouts."""
    from vla_eval.data.decoded_frames import frame_layout, read_columns
    from vla_eval.data.frame_cache import decode_camera

    ours = layout == "lerobot_mikasa"
    cameras = LEROBOT_CAMERAS[layout]
    columns = read_columns(dataset)
    frames = frame_layout(dataset, columns).frames
    videos = zip(*(decode_camera(frames, camera) for camera in cameras), strict=True)
    for rows, (base_TCHW, wrist_TCHW) in zip(frames.episodes, videos, strict=True):
        part = slice(rows.first, rows.stop)

        def column(name: str, part: slice = part) -> Any:  # Any: a numpy array, or None
            return columns[name][part].numpy() if name in columns else None

        task = dataset.meta.tasks.iloc[int(columns["task_index"][rows.first])].name
        yield SourceEpisode(
            name=f"episode {rows.index}",
            images_base_THWC=np.ascontiguousarray(base_TCHW.transpose(0, 2, 3, 1)),
            images_wrist_THWC=np.ascontiguousarray(wrist_TCHW.transpose(0, 2, 3, 1)),
            actions_TA=column("action"),
            joints_TD=column("proprio.joints"),
            proprio_TD=None if ours else column("observation.state"),
            rewards_T=column("next.reward"),
            success_T=column("next.success"),
            done_T=column("next.done"),
            instruction=str(task),
        )


LEROBOT_CAMERAS: Mapping[Layout, tuple[str, str]] = {
    "lerobot_mikasa": ("observation.images.base", "observation.images.wrist"),
    "lerobot_official": ("observation.image", "observation.wrist_image"),
    "lerobot_suite90": ("observation.images.top", "observation.images.wrist"),
}


def lerobot_layout(features: Mapping[str, Any], *, where: Path) -> Layout:  # Any: lerobot's plain data
    """Return which of the layouts a LeRobotDataset has.

    Raises:
        DatasetError: none; or its numbers are not as long as they must be.
    """
    found: list[Layout] = [key for key, cameras in LEROBOT_CAMERAS.items() if set(cameras) <= set(features)]
    if not found:
        pairs = ", or ".join(" and ".join(cameras) for cameras in LEROBOT_CAMERAS.values())
        raise DatasetError(f"{where}: expected the cameras {pairs}; its fields are {', '.join(features)}.")
    expected = {"action": tuple(SOURCE_MODES)}
    if found[0] != "lerobot_mikasa":
        expected["observation.state"] = (N_PROPRIO_NUMBERS,)
    for name, lengths in expected.items():
        shape = tuple(features[name]["shape"]) if name in features else None
        if shape not in [(length,) for length in lengths]:
            wanted = " or ".join(map(str, lengths))
            raise DatasetError(f"{where}: '{name}' is {shape}, expected a vector of {wanted} numbers.")
    return found[0]


def _arrays(path: Path) -> dict[str, NDArray[Any]]:  # Any: arrays of any type
    try:
        with np.load(path, allow_pickle=False) as stored:
            if not isinstance(stored, np.lib.npyio.NpzFile):
                raise DatasetError(f"{path}: a single array, expected an npz file of several.")
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as exc:
        advice = "The file is damaged."
        if "pickle" in str(exc):
            advice = "It holds Python objects, which could run any program: they are never loaded."
        raise DatasetError(f"{path}: cannot be read ({str(exc).splitlines()[0]}). {advice}") from exc


def _numbers(
    path: Path, arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...] | None
) -> FloatArray:
    found = arrays[name]
    if found.dtype.kind not in "fiub" or (shape is not None and found.shape != shape):
        raise DatasetError(f"{path}: {name} is {found.shape} {found.dtype}, expected {shape} numbers.")
    numbers: FloatArray = found.astype(np.float32)
    if not np.isfinite(numbers).all():
        raise DatasetError(f"{path}: {name} has values that are not finite.")
    return numbers


def _optional(
    path: Path, arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...]
) -> FloatArray | None:
    return _numbers(path, arrays, name, shape) if name in arrays else None


def _flags(numbers: FloatArray | None) -> NDArray[np.bool_] | None:
    return None if numbers is None else numbers != 0


def _sentence(path: Path, arrays: Mapping[str, NDArray[Any]]) -> str | None:
    if "language_instruction" not in arrays:
        return None
    found = np.unique(arrays["language_instruction"])
    if found.dtype.kind != "U" or found.size != 1 or not str(found[0]).strip():
        raise DatasetError(f"{path}: language_instruction is {found!r:.80}, expected one sentence.")
    return str(found[0])


def _seed(path: Path, arrays: Mapping[str, NDArray[Any]]) -> int | None:
    if "episode_seed" not in arrays:
        return None
    found = arrays["episode_seed"]
    if found.dtype.kind not in "iu" or found.size != 1:
        raise DatasetError(f"{path}: episode_seed is {found!r:.80}, expected one whole number.")
    return int(found.reshape(()))
