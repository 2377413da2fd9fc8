"""Read demonstrations from a LeRobotDataset of any program: what its fields mean, and its images."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np

from vla_eval.core import ImageArray
from vla_eval.data.checks.demonstrated import Numbers
from vla_eval.data.foreign.episodes import (
    EEF_KEY,
    JOINTS_KEY,
    NUMBER_NAMES,
    PER_STEP,
    SOURCE_MODES,
    SOURCE_PROPRIO_KEY,
    CameraImages,
    Layout,
    Source,
    SourceEpisode,
)
from vla_eval.data.frames.frame_cache import (
    EpisodeRows,
    FrameSource,
    channels_first,
    decode_camera,
    episode_rows,
)
from vla_eval.data.opening import UNREADABLE, LocalDataset, reason
from vla_eval.data.tables import Columns
from vla_eval.errors import DatasetError, did_you_mean
from vla_eval.features import ACTION_KEY, CAMERA_KEYS, STATE_KEY

LEROBOT_CAMERAS: Mapping[Layout, tuple[str, str]] = {
    "lerobot_mikasa": (CAMERA_KEYS["base_camera"], CAMERA_KEYS["hand_camera"]),
    "lerobot_official": ("observation.image", "observation.wrist_image"),
    "lerobot_suite90": ("observation.images.top", "observation.images.wrist"),
}
"""Layout -> fields of the base and the wrist camera."""
OF_LEROBOT = frozenset({"timestamp", "frame_index", "episode_index", "index", "task_index"})
OF_JOINTS = re.compile(r"joint|motor|\.pos$|shoulder|elbow|wrist_(flex|roll)", re.IGNORECASE)


def lerobot_source(opened: LocalDataset) -> Source:
    """Read a dataset without its images."""
    root, dataset, columns = opened.root, opened.whole, opened.columns
    features = dataset.meta.features
    layout = lerobot_layout(features, where=root)
    numbers, remarks = _numbers(root, columns, features)
    cameras = LEROBOT_CAMERAS[layout]
    used = {*cameras, *numbers, *OF_LEROBOT, STATE_KEY}
    stored = [camera for camera in cameras if camera not in dataset.meta.video_keys]
    if stored:
        remarks = (*remarks, f"{' and '.join(stored)}: stored as images, which become video (lossy)")
    files = [file for file in sorted(root.rglob("*")) if file.suffix in (".parquet", ".mp4", ".json")]
    return Source(
        path=root,
        layout=layout,
        files=files,
        fps=dataset.meta.fps,
        episodes=tuple(
            _episode(dataset, rows, numbers, columns, cameras) for rows in episode_rows(dataset, columns)
        ),
        left_out=tuple(sorted(set(features) - used)),
        remarks=remarks,
    )


def lerobot_layout(features: Mapping[str, Any], *, where: Path) -> Layout:  # Any: lerobot's plain data
    """Return which of the layouts a LeRobotDataset has, or raise `DatasetError`."""
    for layout, cameras in LEROBOT_CAMERAS.items():
        if set(cameras) <= set(features):
            return layout
    pairs = ", or ".join(" and ".join(cameras) for cameras in LEROBOT_CAMERAS.values())
    images = [name for name, feature in features.items() if feature["dtype"] in ("image", "video")]
    found = f"its images are {', '.join(images)}" if images else f"its fields are {', '.join(features)}"
    raise DatasetError(
        f"{where}: expected the cameras {pairs} (base, then wrist); {found}. Rename them where the dataset "
        "was made."
    )


def names_of(feature: Mapping[str, Any]) -> tuple[str, ...]:  # Any: lerobot's plain data
    """Return the names of a field's numbers, which may stand in a mapping; empty if there are none."""
    names = feature.get("names") or ()
    if isinstance(names, Mapping):
        names = [name for part in names.values() for name in (part if isinstance(part, list) else [part])]
    return tuple(map(str, names))


def _numbers(
    root: Path, columns: Columns, features: Mapping[str, Any]
) -> tuple[dict[str, Numbers], tuple[str, ...]]:
    """Return the numbers by our names, and what is assumed of them."""
    if ACTION_KEY not in columns:
        raise DatasetError(f"{root}: there is no '{ACTION_KEY}'.{did_you_mean(ACTION_KEY, columns)}")
    action_remarks = _check_vector(root, ACTION_KEY, columns, features, tuple(SOURCE_MODES))
    state, state_remarks = _states(root, columns, features)
    per_frame = {name: columns[name].reshape(len(columns[name]), -1) for name in PER_STEP if name in columns}
    for name, rows in per_frame.items():
        if rows.shape[1] != 1 or rows.dtype.kind not in "biuf":
            raise DatasetError(
                f"{root}: '{name}' is {rows.shape[1:]} {rows.dtype}, expected one number per frame."
            )
    numbers = {
        ACTION_KEY: columns[ACTION_KEY],
        **state,
        **{name: rows[:, 0] for name, rows in per_frame.items()},
    }
    return numbers, (*action_remarks, *state_remarks)


def _states(
    root: Path, columns: Columns, features: Mapping[str, Any]
) -> tuple[dict[str, Numbers], tuple[str, ...]]:
    """Return proprioception: ours by its names, or seven numbers as the authors' releases have them."""
    ours = {}
    for field in (JOINTS_KEY, EEF_KEY, SOURCE_PROPRIO_KEY):
        if field in columns:
            _check_vector(root, field, columns, features, (len(NUMBER_NAMES[field]),))
            ours[field] = columns[field]
    if ours:
        return ours, ()
    if STATE_KEY not in columns:
        raise DatasetError(f"{root}: there is no '{STATE_KEY}'.{did_you_mean(STATE_KEY, columns)}")
    names = names_of(features[STATE_KEY])
    for field, known in NUMBER_NAMES.items():
        if names == known:
            return {field: columns[STATE_KEY]}, ()
    remarks = _check_vector(root, STATE_KEY, columns, features, (len(NUMBER_NAMES[SOURCE_PROPRIO_KEY]),))
    return {SOURCE_PROPRIO_KEY: columns[STATE_KEY]}, remarks


def _check_vector(
    root: Path, name: str, columns: Columns, features: Mapping[str, Any], lengths: tuple[int, ...]
) -> tuple[str, ...]:
    """Return what is assumed of a vector; refuse other lengths, and joints where a pose is expected."""
    rows = columns[name]
    if rows.ndim != 2 or rows.shape[1] not in lengths or rows.dtype.kind not in "biuf":
        wanted = " or ".join(map(str, lengths))
        raise DatasetError(
            f"{root}: '{name}' is {rows.shape[1:]} {rows.dtype}, expected a vector of {wanted} numbers."
        )
    n_dims, names = rows.shape[1], names_of(features[name])
    if n_dims != 7 or not names:
        return ()
    is_action = name == ACTION_KEY
    meaning = (
        "dx, dy, dz, drx, dry, drz, gripper of pd_ee_delta_pose"
        if is_action
        else f"{', '.join(NUMBER_NAMES[SOURCE_PROPRIO_KEY])}"
    )
    of_joints = [one for one in names if OF_JOINTS.search(one)]
    if of_joints:
        raise DatasetError(
            f"{root}: '{name}' has the names {', '.join(names)}, which are those of joints; expected "
            f"{meaning}. Nothing is computed from joints alone."
        )
    return (f"the {n_dims} numbers of {name} ({', '.join(names)}) are read as {meaning}",)


def _episode(
    dataset: Any,
    rows: EpisodeRows,
    numbers: Mapping[str, Numbers],
    columns: Columns,
    cameras: tuple[str, str],
) -> SourceEpisode:
    part = slice(rows.first, rows.stop)
    sentences = dataset.meta.tasks.index
    base, wrist = (channels_first(dataset.meta.features[camera])[1:] for camera in cameras)
    return SourceEpisode(
        name=f"episode {rows.index}",
        numbers={name: values[part] for name, values in numbers.items()},
        sentences=tuple(str(sentences[int(index)]) for index in columns["task_index"][part]),
        image_sizes_px=(base, wrist),
        read_images=lambda: _images(dataset, rows, cameras),
    )


def _images(dataset: Any, rows: EpisodeRows, cameras: tuple[str, str]) -> CameraImages:
    base, wrist = (
        _decoded(dataset, rows, camera)
        if camera in dataset.meta.video_keys
        else _stored(dataset, rows, camera)
        for camera in cameras
    )
    return base, wrist


def _decoded(dataset: Any, rows: EpisodeRows, camera: str) -> ImageArray:
    shape = channels_first(dataset.meta.features[camera])
    (frames_TCHW,) = decode_camera(
        FrameSource(dataset=dataset, shapes={camera: shape}, episodes=[rows]), camera
    )
    return np.ascontiguousarray(frames_TCHW.transpose(0, 2, 3, 1))


def _stored(dataset: Any, rows: EpisodeRows, camera: str) -> ImageArray:
    _, height, width = channels_first(dataset.meta.features[camera])
    table = dataset.hf_dataset.with_format(None).select_columns([camera])
    frames = []
    for row in range(rows.first, rows.stop):
        try:
            image = table[row][camera]
            frame = np.asarray(image)
        except UNREADABLE as exc:
            raise DatasetError(
                f"{dataset.root}: frame {row - rows.first} of episode {rows.index}, camera '{camera}', "
                f"cannot be decoded ({reason(exc)}). The image is damaged."
            ) from exc
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            raise DatasetError(
                f"{dataset.root}: frame {row - rows.first} of episode {rows.index}, camera '{camera}', is "
                f"{frame.shape} {frame.dtype} ({image.mode}), expected {(height, width, 3)} uint8 (RGB)."
            )
        frames.append(frame)
    return np.stack(frames)
