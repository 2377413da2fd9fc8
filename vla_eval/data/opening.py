"""The door for datasets: open one on this machine, checked, through readers of ours, and never the network.

lerobot's own readers take types from the files, open what they name, look on the Hub for whatever is missing,
and cache by name and time. `lerobot_tables.py` says what they are replaced by.
"""

import contextlib
import functools
import importlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn  # lerobot is untyped
from unittest.mock import patch

import numpy as np
from av.error import FFmpegError
from lerobot.datasets import dataset_metadata, dataset_reader
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL.Image import DecompressionBombError

from vla_eval.data.folder_contents import check_folder
from vla_eval.data.info_file import check_info
from vla_eval.data.lerobot_tables import read_episodes, read_frames, read_statistics, read_tasks
from vla_eval.data.tables import EPISODE_TABLES, FRAME_TABLES, refused
from vla_eval.errors import DatasetError
from vla_eval.viz.mp4 import check_mp4

UNREADABLE = (
    *(OSError, RuntimeError, ValueError, LookupError, TypeError, OverflowError, MemoryError),
    *(FFmpegError, DecompressionBombError),
)
"""What lerobot, FFmpeg, Pillow and pyarrow raise on damaged content."""
NEEDED = ("meta/info.json", "meta/tasks.parquet", EPISODE_TABLES, FRAME_TABLES)


def open_local_dataset(root: Path, **options: Any) -> LeRobotDataset:
    """Open a dataset that is there in full.

    Args:
        root: the dataset's folder.
        options: of `LeRobotDataset`.

    Raises:
        DatasetError: there is none, or files are missing, damaged, or do not belong together.
    """
    check_folder(root)
    for pattern in NEEDED:
        if next(root.glob(pattern), None) is None:
            raise DatasetError(
                f"{root}: there is no complete LeRobotDataset (v3): no {pattern}. Name the folder of one "
                f"dataset; `mikasa-vla dataset pull` fetches one from the Hub."
            )
    check_info(root)
    with local_readers():
        return _open(root, options)


def read_sample(dataset: Any, index: int) -> dict[str, Any]:  # Any: LeRobotDataset; tensors, and a sentence
    """Return one frame of an opened dataset, with its images.

    Raises:
        DatasetError: a video or an image is damaged, or holds nothing for this frame.
    """
    try:
        sample: dict[str, Any] = dataset[index]
    except UNREADABLE as exc:
        raise DatasetError(
            f"{dataset.root}: frame {index} cannot be read ({reason(exc)}). A video or image is damaged, or "
            "belongs to another dataset. Fetch the dataset again."
        ) from exc
    return sample


def reason(exc: BaseException) -> str:
    """Return the first line of an error of another library."""
    return next(iter(str(exc).splitlines()), type(exc).__name__)[:200]


@contextlib.contextmanager
def local_readers() -> Iterator[None]:
    """Let lerobot read datasets by our readers, which are given no address, and ask the Hub for nothing."""
    replaced = (
        (dataset_metadata, "load_episodes", read_episodes),
        (dataset_metadata, "load_tasks", read_tasks),
        (dataset_metadata, "load_stats", read_statistics),
        (dataset_metadata, "get_safe_version", _refuse_hub),
        (dataset_reader, "load_nested_dataset", read_frames),
        (LeRobotDatasetMetadata, "_pull_from_repo", _refuse_hub),
        (LeRobotDataset, "_download", _refuse_hub),
    )
    with contextlib.ExitStack() as stack:
        for owner, name, ours in replaced:
            stack.enter_context(patch.object(owner, name, ours))
        yield


def join_datasets(roots: Sequence[Path], root: Path, **options: Any) -> None:
    """Put datasets together as a new one, by lerobot.

    Args:
        roots: of the datasets, in order.
        root: of the new one; must not exist.
        options: of lerobot's `aggregate_datasets`.

    Raises:
        ValueError: they do not have the same fields.
    """
    with local_readers():
        aggregate_datasets(
            repo_ids=[_repo_id(one) for one in roots],
            aggr_repo_id=_repo_id(root),
            roots=list(roots),
            aggr_root=root,
            **options,
        )


def _repo_id(root: Path) -> str:
    return f"local/{root.resolve().name}"


def _refuse_hub(*_: object, **__: object) -> NoReturn:
    raise DatasetError(
        "lerobot misses files or episodes of this dataset, and would ask the Hub for them. Fetch the whole "
        "dataset again (`hf download --repo-type dataset`), or rebuild it from its manifest."
    )


def _open(root: Path, options: dict[str, Any]) -> LeRobotDataset:
    repo_id = _repo_id(root)
    try:
        meta = LeRobotDatasetMetadata(repo_id, root=root)
    except UNREADABLE as exc:
        raise DatasetError(f"{root}: lerobot cannot read its meta/ ({exc!r:.300}).") from exc
    _check_totals(root, meta)
    _check_videos(root, meta)
    for path in _files(meta):
        if not (root / path).is_file():
            raise DatasetError(
                f"{root}: {path} is missing. Fetch the dataset again, or rebuild it from its manifest."
            )
    options.setdefault("video_backend", decoder_for(root))
    try:
        dataset = LeRobotDataset(repo_id, root=root, **options)
    except UNREADABLE as exc:
        raise DatasetError(f"{root}: lerobot cannot read the dataset ({exc!r:.300}).") from exc
    _check_rows(dataset)
    return dataset


def decoder_for(root: Path) -> str:
    """Return lerobot's name of the decoder for a dataset's videos.

    lerobot hands their paths to fsspec for torchcodec, and fsspec takes `::` for a chain of addresses.
    """
    return "pyav" if "::" in str(root.absolute()) else video_decoder()


@functools.cache
def video_decoder() -> str:
    """Return lerobot's name of the decoder: `torchcodec`, or `pyav` where that cannot be loaded.

    The same choice as lerobot's `get_safe_default_video_backend`, which says in ninety lines why torchcodec
    cannot be loaded (it wants FFmpeg's libraries; PyAV brings its own), each time that it is asked.
    """
    try:
        importlib.import_module("torchcodec")
    except (ImportError, OSError, RuntimeError):
        return "pyav"
    return "torchcodec"


def _files(meta: LeRobotDatasetMetadata) -> list[Path]:
    numbers = range(meta.total_episodes)
    return sorted({Path(meta.get_data_file_path(number)) for number in numbers} | _videos(meta))


def _videos(meta: LeRobotDatasetMetadata) -> set[Path]:
    numbers = range(meta.total_episodes)
    return {
        Path(meta.get_video_file_path(number, camera)) for camera in meta.video_keys for number in numbers
    }


# ------------------------------------------------------------------------------------------- checks


def _check_totals(root: Path, meta: LeRobotDatasetMetadata) -> None:
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


def _check_videos(root: Path, meta: LeRobotDatasetMetadata) -> None:
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
    for path in _videos(meta):
        if (root / path).is_file():
            check_mp4(root / path, DatasetError)


def _check_rows(dataset: LeRobotDataset) -> None:
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
    if not np.isfinite(found["timestamp"]).all() or (found["timestamp"] < 0).any():
        raise refused(dataset.root / "data", "a time from 0 on in each row of timestamp", "another value")
    n_tasks = len(dataset.meta.tasks)
    if not np.isin(found["task_index"], np.arange(n_tasks)).all():
        raise refused(dataset.root / "data", f"a task_index from 0 to {n_tasks - 1}", "another")


ROW_NUMBERS = ("index", "episode_index", "frame_index", "timestamp", "task_index")


def _first_difference(expected: Any, found: Any) -> str:  # Any: arrays
    if len(expected) != len(found):
        return f"{len(found)} rows"
    row = int(np.flatnonzero(expected != found)[0])
    return f"{found[row]} in row {row}, where {expected[row]} is due"
