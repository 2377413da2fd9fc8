"""The door for datasets: open one on this machine, checked, through readers of ours, and never the network.

lerobot's own readers take types from the files, open what they name, look on the Hub for whatever is missing,
and cache by name and time. `lerobot_tables.py` says what they are replaced by.
"""

import contextlib
import functools
import importlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn  # lerobot is untyped
from unittest.mock import patch

from av.error import FFmpegError
from lerobot.datasets import dataset_metadata, dataset_reader
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL.Image import DecompressionBombError

from vla_eval.data.checks.agreement import check_meta, check_rows
from vla_eval.data.folder_contents import check_folder
from vla_eval.data.info_file import INFO_FILE, check_info
from vla_eval.data.lerobot_tables import read_episodes, read_frames, read_statistics, read_tasks
from vla_eval.data.tables import EPISODE_TABLES, FRAME_TABLES
from vla_eval.errors import DatasetError

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
    if (root / INFO_FILE).is_file():
        check_info(root)  # first: the files of older versions have other names
    for pattern in NEEDED:
        if next(root.glob(pattern), None) is None:
            raise DatasetError(
                f"{root}: there is no complete LeRobotDataset (v3): no {pattern}. Name the folder of one "
                f"dataset; `mikasa-vla dataset pull` fetches one from the Hub."
            )
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
    check_meta(root, meta)
    options.setdefault("video_backend", decoder_for(root))
    try:
        dataset = LeRobotDataset(repo_id, root=root, **options)
    except UNREADABLE as exc:
        raise DatasetError(f"{root}: lerobot cannot read the dataset ({exc!r:.300}).") from exc
    check_rows(dataset)
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
