"""Whether the files of a LeRobotDataset belong together: counts, rows, times, videos."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np
from numpy.typing import NDArray

from vla_eval.data.tables import refused
from vla_eval.errors import DatasetError
from vla_eval.viz.mp4 import check_mp4

ROW_NUMBERS = ("index", "episode_index", "frame_index", "timestamp", "task_index")
TIME_TOLERANCE_S = 1e-4  # lerobot's: a frame that is farther from its time is an error
FLOAT32_STEP = 2.0**-23  # relative


def check_meta(root: Path, meta: Any) -> None:
    """Raise `DatasetError` unless what `meta/` describes is there, and it counts what there is."""
    _check_totals(root, meta)
    _check_videos(root, meta)
    places = {Path(meta.get_data_file_path(number)) for number in range(meta.total_episodes)}
    for path in sorted(places | set(episodes_by_video(meta))):
        if not (root / path).is_file():
            raise DatasetError(
                f"{root}: {path} is missing. Fetch the dataset again, or rebuild it from its manifest."
            )


def episodes_by_video(meta: Any) -> dict[Path, tuple[str, list[int]]]:
    """Return path below the dataset -> camera, and the numbers of the episodes whose frames it holds."""
    found: dict[Path, tuple[str, list[int]]] = {}
    for camera in meta.video_keys:
        for number in range(meta.total_episodes):
            path = Path(meta.get_video_file_path(number, camera))
            found.setdefault(path, (camera, []))[1].append(number)
    return found


def _check_totals(root: Path, meta: Any) -> None:
    """Raise `DatasetError` unless `info.json` counts what the tables hold."""
    rows: Any = meta.episodes if meta.episodes is not None else ()
    n_frames = rows[-1]["dataset_to_index"] if rows else 0
    found = {
        "episodes": (meta.total_episodes, len(rows)),
        "frames": (meta.total_frames, n_frames),
        "tasks": (meta.total_tasks, 0 if meta.tasks is None else len(meta.tasks)),
    }
    for what, (said, counted) in found.items():
        if said != counted or not counted:
            where = "meta/tasks.parquet" if what == "tasks" else "meta/episodes"
            raise DatasetError(
                f"{root}: meta/info.json says {said} {what}, {where} has {counted}. Fetch the dataset again, "
                "or rebuild it from its manifest."
            )


def _check_videos(root: Path, meta: Any) -> None:
    """Raise `DatasetError` unless each camera's videos are named, begin at a time, and are MP4 files."""
    rows: Mapping[str, Any] = meta.episodes[:]
    where = root / "meta/episodes"
    if meta.video_keys and meta.info.video_path is None:
        raise refused(root / "meta/info.json", "a video_path for its videos", "null")
    for camera in meta.video_keys:
        for name, kinds in (("chunk_index", int), ("file_index", int), ("from_timestamp", (int, float))):
            column = f"videos/{camera}/{name}"
            values = rows.get(column, [None])
            if not all(isinstance(one, kinds) and 0 <= one < float("inf") for one in values):
                raise refused(where, f"a number in each row of {column}", f"{values!s:.80}")
    for path, (camera, numbers) in episodes_by_video(meta).items():
        columns = (f"videos/{camera}/from_timestamp", "dataset_from_index", "dataset_to_index")
        spans = [np.array(rows[name], dtype=np.float64)[numbers] for name in columns]
        _check_times(where, path, numbers, spans, fps=meta.fps)
        if (root / path).is_file():
            check_mp4(root / path, DatasetError)


def _check_times(
    where: Path, path: Path, numbers: list[int], spans: Sequence[NDArray[np.float64]], *, fps: float
) -> None:
    """Raise `DatasetError` where two episodes have frames of a video in common."""
    begins_s, firsts, stops = spans
    ends_s = begins_s + (stops - firsts) / fps
    half_frame_s = 0.5 / fps
    for before, after in pairwise(np.argsort(begins_s, kind="stable")):
        if begins_s[after] < ends_s[before] - half_frame_s:
            one, other = numbers[before], numbers[after]
            raise refused(
                where,
                f"frames of their own for episodes {one} and {other} in {path}",
                f"{one} until {ends_s[before]:.3f} s and {other} from {begins_s[after]:.3f} s on",
            )


def check_rows(dataset: Any) -> None:
    """Raise `DatasetError` unless the rows of frames are those that `meta/episodes` describes."""
    table: Any = dataset.hf_dataset.data
    found = {name: table.column(name).to_numpy() for name in ROW_NUMBERS if name in table.column_names}
    rows = dataset.meta.episodes[:]
    ends = list(zip(rows["dataset_from_index"], rows["dataset_to_index"], strict=True))
    chosen = range(len(ends)) if dataset.episodes is None else sorted(dataset.episodes)
    lengths = [ends[number][1] - ends[number][0] for number in chosen]
    expected = {
        "index": np.concatenate([np.arange(*ends[number]) for number in chosen]),
        "episode_index": np.repeat(np.asarray(chosen), lengths),
        "frame_index": np.concatenate([np.arange(length) for length in lengths]),
    }
    for name in ROW_NUMBERS:
        if name not in found:
            raise refused(dataset.root / "data", f"the column {name}", ", ".join(found))
    for name, values in expected.items():
        if not np.array_equal(found[name], values):
            raise refused(
                dataset.root / "data",
                f"in {name} the {len(values)} rows that meta/episodes describes",
                _first_difference(values, found[name]),
            )
    _check_timestamps(dataset.root / "data", found["timestamp"], expected["frame_index"], dataset.meta.fps)
    n_tasks = len(dataset.meta.tasks)
    if not np.isin(found["task_index"], np.arange(n_tasks)).all():
        raise refused(dataset.root / "data", f"a task_index from 0 to {n_tasks - 1}", "another")


def _check_timestamps(where: Path, times_s: Any, frames: Any, fps: float) -> None:
    """Raise `DatasetError` unless frame i of an episode was taken i / fps seconds after its first."""
    due = frames / fps
    tolerance_s = np.maximum(TIME_TOLERANCE_S, 2 * FLOAT32_STEP * due)
    wrong = np.flatnonzero(~(np.abs(times_s - due) <= tolerance_s))  # NaN is wrong, too
    if len(wrong):
        row = int(wrong[0])
        raise refused(
            where,
            f"timestamp {due[row]:.4f} s in frame {frames[row]} of an episode ({fps} frames per second)",
            f"{times_s[row]:.4f} s in row {row} ({len(wrong)} rows of {len(times_s)} are off)",
        )


def _first_difference(expected: Any, found: Any) -> str:  # Any: arrays
    if len(expected) != len(found):
        return f"{len(found)} rows"
    row = int(np.flatnonzero(expected != found)[0])
    return f"{found[row]} in row {row}, where {expected[row]} is due"
