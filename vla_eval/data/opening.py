"""Open a dataset on this machine, never the network: lerobot looks on the Hub for whatever is missing."""

import contextlib
import functools
import importlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any  # lerobot is untyped

import pyarrow.parquet as pq
from datasets import Dataset  # type: ignore[attr-defined]  # mypy sees the folder of recipes
from lerobot.datasets import dataset_metadata
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import EPISODES_DIR
from lerobot.utils.utils import SuppressProgressBars

from vla_eval.data.info_file import check_info
from vla_eval.errors import DatasetError

NEEDED = ("meta/info.json", "meta/tasks.parquet", "meta/episodes/*/*.parquet", "data/*/*.parquet")


def open_local_dataset(root: Path, **options: Any) -> LeRobotDataset:
    """Open a dataset that is there in full.

    Args:
        root: the dataset's folder.
        options: of `LeRobotDataset`.

    Raises:
        DatasetError: there is none, or files are missing, or they do not belong together.
    """
    for pattern in NEEDED:
        if next(root.glob(pattern), None) is None:
            raise DatasetError(
                f"{root}: there is no complete LeRobotDataset (v3): no {pattern}. Name the folder of one "
                f"dataset; `mikasa-vla dataset pull` fetches one from the Hub."
            )
    check_info(root)
    with light_metadata():
        return _open(root, options)


@contextlib.contextmanager
def light_metadata() -> Iterator[None]:
    """Let lerobot read of `meta/episodes` only the columns that it keeps.

    It reads the statistics of each episode, too (140 columns of a recording), and drops them. `datasets`
    describes a table again for each of its columns: 0.15 s for each opening, and 0.01 s without them.
    """
    before = dataset_metadata.load_episodes
    dataset_metadata.load_episodes = _episodes_without_statistics
    try:
        yield
    finally:
        dataset_metadata.load_episodes = before


def join_datasets(roots: Sequence[Path], root: Path, **options: Any) -> None:
    """Put datasets together as a new one, by lerobot.

    Args:
        roots: of the datasets, in order.
        root: of the new one; must not exist.
        options: of lerobot's `aggregate_datasets`.

    Raises:
        ValueError: they do not have the same fields.
    """
    with light_metadata():
        aggregate_datasets(
            repo_ids=[f"local/{one.resolve().name}" for one in roots],
            aggr_repo_id=f"local/{root.name}",
            roots=list(roots),
            aggr_root=root,
            **options,
        )


def _episodes_without_statistics(root: Path) -> Dataset:
    paths = sorted((root / EPISODES_DIR).glob("*/*.parquet"))
    if not paths:
        raise FileNotFoundError(f"{root / EPISODES_DIR}: there are no tables of episodes.")
    kept = [name for name in pq.read_schema(paths[0]).names if not name.startswith("stats/")]
    with SuppressProgressBars():
        return Dataset.from_parquet([str(path) for path in paths], columns=kept)


def _open(root: Path, options: dict[str, Any]) -> LeRobotDataset:
    repo_id = f"local/{root.resolve().name}"
    try:
        meta = LeRobotDatasetMetadata(repo_id, root=root)
    except (OSError, ValueError, KeyError, TypeError) as exc:
        raise DatasetError(f"{root}: lerobot cannot read its meta/ ({exc!r:.300}).") from exc
    if meta.total_episodes != len(meta.episodes):
        raise DatasetError(
            f"{root}: meta/info.json says {meta.total_episodes} episodes, meta/episodes has "
            f"{len(meta.episodes)}. Fetch the dataset again, or rebuild it from its manifest."
        )
    for path in _files(meta):
        if path.is_absolute() or ".." in path.parts:
            raise DatasetError(
                f"{root}: meta/info.json says that a file lies at {path!s:.200}; expected a path inside of "
                "the dataset. It is not read. Fetch the dataset again, from where you trust it."
            )
        if not (root / path).is_file():
            raise DatasetError(
                f"{root}: {path} is missing. Fetch the dataset again, or rebuild it from its manifest."
            )
    options.setdefault("video_backend", video_decoder())
    try:
        return LeRobotDataset(repo_id, root=root, **options)
    except (OSError, ValueError, KeyError, RuntimeError) as exc:
        raise DatasetError(f"{root}: lerobot cannot read the dataset ({exc!r:.300}).") from exc


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
    tables = [meta.get_data_file_path(number) for number in numbers]
    videos = [meta.get_video_file_path(number, camera) for camera in meta.video_keys for number in numbers]
    return sorted({Path(path) for path in (*tables, *videos)})
