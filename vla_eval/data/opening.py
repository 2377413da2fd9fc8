"""Open a dataset on this machine, never the network: lerobot looks on the Hub for whatever is missing."""

import functools
import importlib
from pathlib import Path
from typing import Any  # lerobot is untyped

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

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
