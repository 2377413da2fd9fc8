"""Read demonstrations from `*.npz`, one file per episode. Files are never unpickled.

- The paper's: `rgb (T, H, W, 6)` uint8 base, then wrist camera; `joints (T, 25)`; `action (T, 7 or 8)`;
  `reward`, `success`, `done` (T,).
- The authors' later ones, for VLAs: instead of `joints` `proprio (T, 7)`, position, roll, pitch, yaw,
  gripper width; also `language_instruction`, `episode_seed`.
"""

import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_eval.data.checks.demonstrated import Numbers
from vla_eval.data.foreign.episodes import (
    JOINTS_KEY,
    NUMBER_NAMES,
    SOURCE_MODES,
    SOURCE_PROPRIO_KEY,
    CameraImages,
    Source,
    SourceEpisode,
)
from vla_eval.errors import DatasetError, did_you_mean
from vla_eval.features import ACTION_KEY, DONE_KEY, FPS, REWARD_KEY, SUCCESS_KEY

Arrays = Mapping[str, NDArray[Any]]  # Any: arrays of any type
RGB, ACTION = "rgb", "action"
FIELDS = {
    "joints": JOINTS_KEY,
    "proprio": SOURCE_PROPRIO_KEY,
    "reward": REWARD_KEY,
    "success": SUCCESS_KEY,
    "done": DONE_KEY,
}
"""Name in the file -> field."""
SENTENCE, SEED = "language_instruction", "episode_seed"
KNOWN = (RGB, ACTION, *FIELDS, SENTENCE, SEED)
N_CHANNELS = 6  # of both cameras
UNREADABLE = (OSError, ValueError, EOFError, KeyError, NotImplementedError, RuntimeError, zipfile.BadZipFile)


def npz_files(folder: Path) -> list[Path]:
    """Return the npz files of a folder, `train_data_10.npz` after `train_data_9.npz`."""

    def key(path: Path) -> list[tuple[bool, int, str]]:
        parts = re.split(r"(\d+)", path.stem)
        return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts if part]

    return sorted(folder.glob("*.npz"), key=key)


def npz_source(folder: Path, files: Sequence[Path]) -> Source:
    """Read a folder of such files, without their images; errors as `read_npz`."""
    read = [read_npz(file) for file in files]
    has_joints = JOINTS_KEY in read[0][0].numbers
    return Source(
        path=folder,
        layout="npz_joints" if has_joints else "npz_proprio",
        files=files,
        fps=FPS,
        episodes=tuple(episode for episode, _ in read),
        left_out=tuple(sorted({name for _, unknown in read for name in unknown})),
    )


def read_npz(path: Path) -> tuple[SourceEpisode, Sequence[str]]:
    """Read one episode, and the names of the arrays in the file that have no place in it."""
    names: list[str] = list(_read(path, lambda stored: stored.files))
    for name in (RGB, ACTION):
        if name not in names:
            raise DatasetError(
                f"{path}: there is no '{name}'.{did_you_mean(name, names)} It has: {', '.join(names)}. "
                f"docs/dataset_tools.md lists the layouts that can be read."
            )
    if "joints" not in names and "proprio" not in names:
        raise DatasetError(f"{path}: there is neither 'joints' (T, 25) nor 'proprio' (T, 7).")
    arrays = _arrays(path, [name for name in names if name in KNOWN and name != RGB])
    actions = _numbers(path, arrays, ACTION, None)
    n_frames = len(actions)
    if actions.ndim != 2 or actions.shape[1] not in SOURCE_MODES:
        raise DatasetError(f"{path}: action is {actions.shape}, expected (T, 7) or (T, 8).")
    shape = _image_shape(path)
    if len(shape) != 4 or (shape[0], shape[3]) != (n_frames, N_CHANNELS):
        raise DatasetError(f"{path}: rgb is {shape}, expected ({n_frames}, height, width, 6).")
    size = (shape[1], shape[2])
    numbers = {
        field: _numbers(path, arrays, name, (n_frames, *_dims(field)))
        for name, field in FIELDS.items()
        if name in arrays
    }
    episode = SourceEpisode(
        name=path.name,
        numbers={ACTION_KEY: actions, **numbers},
        sentences=_sentences(path, arrays, n_frames),
        image_sizes_px=(size, size),
        read_images=lambda: _images(path),
        seed=_seed(path, arrays),
    )
    return episode, [name for name in names if name not in KNOWN]


def _dims(field: str) -> tuple[int, ...]:
    n_dims = len(NUMBER_NAMES[field])
    return (n_dims,) if n_dims > 1 else ()


def _arrays(path: Path, names: Sequence[str]) -> Arrays:
    arrays: Arrays = _read(path, lambda stored: {name: stored[name] for name in names})
    return arrays


def _images(path: Path) -> CameraImages:
    rgb = _arrays(path, [RGB])[RGB]
    base, wrist = np.ascontiguousarray(rgb[..., :3]), np.ascontiguousarray(rgb[..., 3:])
    return base, wrist


def _image_shape(path: Path) -> tuple[int, ...]:
    """Return the shape of the images by their header: they are decoded when they are encoded again."""
    shape, dtype = _read(path, _header)
    if dtype != np.uint8:
        raise DatasetError(f"{path}: rgb is {shape} {dtype}, expected uint8.")
    return tuple(shape)


def _header(stored: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:  # Any: numpy's file; of any type
    with stored.zip.open(f"{RGB}.npy") as file:
        version = np.lib.format.read_magic(file)  # type: ignore[no-untyped-call]  # numpy 2.2
        name = f"read_array_header_{'1_0' if version == (1, 0) else '2_0'}"
        shape, _, dtype = getattr(np.lib.format, name)(file)
    return shape, dtype


def _read(path: Path, what: Any) -> Any:  # Any: a function of numpy's file, and what it returns
    try:
        with np.load(path, allow_pickle=False) as stored:
            if not isinstance(stored, np.lib.npyio.NpzFile):
                raise DatasetError(f"{path}: a single array, expected an npz file of several.")
            return what(stored)
    except UNREADABLE as exc:
        advice = "The file is damaged."
        if "pickle" in str(exc):
            advice = "It holds Python objects, which could run any program: they are never loaded."
        lines = str(exc).splitlines() or [type(exc).__name__]
        raise DatasetError(f"{path}: cannot be read ({lines[0]}). {advice}") from exc


def _numbers(path: Path, arrays: Arrays, name: str, shape: tuple[int, ...] | None) -> Numbers:
    found = arrays[name]
    if found.dtype.kind not in "fiub" or (shape is not None and found.shape != shape):
        raise DatasetError(f"{path}: {name} is {found.shape} {found.dtype}, expected {shape} numbers.")
    return found


def _sentences(path: Path, arrays: Arrays, n_frames: int) -> tuple[str | None, ...]:
    if SENTENCE not in arrays:
        return (None,) * n_frames
    found = arrays[SENTENCE].reshape(-1)
    if found.dtype.kind != "U" or found.size not in (1, n_frames):
        raise DatasetError(
            f"{path}: {SENTENCE} is {arrays[SENTENCE]!r:.80}, expected one sentence, or one per frame."
        )
    sentences = tuple(str(one) for one in found)
    return sentences if len(sentences) == n_frames else sentences * n_frames


def _seed(path: Path, arrays: Arrays) -> int | None:
    if SEED not in arrays:
        return None
    found = arrays[SEED]
    if found.dtype.kind not in "iu" or found.size != 1:
        raise DatasetError(f"{path}: {SEED} is {found!r:.80}, expected one whole number.")
    return int(found.reshape(()))
