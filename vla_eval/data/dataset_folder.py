"""Check that a dataset is complete and undamaged, and open it without going to the network."""

import contextlib
import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any  # lerobot is untyped

import huggingface_hub
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from vla_eval.data.manifest import (
    FAILED_FILE,
    MANIFEST_FILE,
    RECORDING_FILE,
    DatasetFacts,
    FileDigest,
    read_facts,
)
from vla_eval.data.opening import open_local_dataset
from vla_eval.errors import DatasetError

BLOCK_BYTES = 1 << 20
# What a dataset consists of; a card, a replay's report and what the Hub's client leaves are not part of it.
CONTENT = (
    "data/**/*.parquet",
    "videos/**/*.mp4",
    "meta/*.json",
    "meta/*.parquet",
    "meta/episodes/**/*.parquet",
)


def open_recorded(path: Path, **options: Any) -> LeRobotDataset:
    """Open a finished dataset, offline: what training reads.

    Args:
        path: the dataset's folder, OUT/TASK.
        options: what `LeRobotDataset` takes, such as `delta_timestamps` and `episodes`.

    Raises:
        DatasetError: it is not complete, or a file is missing or not what was recorded.
    """
    check_dataset(path)
    with _offline():
        return open_local_dataset(path, **options)


@contextlib.contextmanager
def _offline() -> Iterator[None]:
    """Let a request to the Hub be an error: lerobot fetches what it misses without asking."""
    before = huggingface_hub.constants.HF_HUB_OFFLINE
    huggingface_hub.constants.HF_HUB_OFFLINE = True
    try:
        yield
    finally:
        huggingface_hub.constants.HF_HUB_OFFLINE = before


def check_dataset(path: Path, *, read_bytes: bool = True) -> DatasetFacts:
    """Raise `DatasetError` unless the dataset is complete and its files are what was recorded.

    Args:
        path: the dataset's folder.
        read_bytes: compare digests, too, and not just sizes.

    Returns:
        What the dataset is.
    """
    facts = read_facts(path)
    for name, expected in facts.files.items():
        file = path / name
        if not file.is_file():
            raise DatasetError(f"{path}: the file {name} is missing. {_REPAIR}")
        n_bytes = file.stat().st_size
        if n_bytes != expected.n_bytes:
            raise DatasetError(
                f"{file}: expected {expected.n_bytes} bytes, found {n_bytes}: the file is damaged. {_REPAIR}"
            )
        if read_bytes and digest_file(file).sha256 != expected.sha256:
            raise DatasetError(f"{file}: its content is not what was recorded. {_REPAIR}")
    return facts


_REPAIR = (
    "Fetch or record the dataset again, or make it from its manifest: "
    "`mikasa-vla replay DATASET --rebuild OUT`."
)


def digest_file(path: Path) -> FileDigest:
    """Return size and sha256 of a file."""
    digest = hashlib.sha256()
    n_bytes = 0
    with path.open("rb") as file:
        while block := file.read(BLOCK_BYTES):
            digest.update(block)
            n_bytes += len(block)
    return FileDigest(n_bytes=n_bytes, sha256=digest.hexdigest())


def digest_files(dataset: Path) -> dict[str, FileDigest]:
    """Return path below the dataset -> digest of everything that the dataset consists of."""
    return {name: digest_file(dataset / name) for name in sorted(_content(dataset))}


def _content(dataset: Path) -> Iterable[str]:
    found = {path for pattern in CONTENT for path in dataset.glob(pattern)}
    found |= {dataset / MANIFEST_FILE, dataset / FAILED_FILE}
    found -= {dataset / RECORDING_FILE}
    return (path.relative_to(dataset).as_posix() for path in found if path.is_file())
