"""The door for datasets: open one on this machine, checked, each file once, and never the network.

lerobot's own readers take types from the files, open what they name, look on the Hub for whatever is missing,
and cache by name and time. `lerobot_tables.py` has what replaces them.
"""

import contextlib
import copy
import functools
import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn  # lerobot is untyped
from unittest.mock import patch

import numpy as np
from av.error import FFmpegError
from lerobot.datasets import dataset_metadata, dataset_reader
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import DatasetInfo
from PIL.Image import DecompressionBombError

from vla_eval.control_modes import MOTORS
from vla_eval.data.checks.agreement import check_meta, check_rows
from vla_eval.data.dataset_folder import check_complete
from vla_eval.data.facts import ArmFacts, DatasetFacts, Facts, MixtureFacts, files_sha256
from vla_eval.data.folder_contents import check_folder
from vla_eval.data.info_file import INFO_FILE
from vla_eval.data.lerobot_tables import Tables, frames_for_lerobot
from vla_eval.data.manifest import (
    MANIFEST_FILE,
    FailedSeed,
    RecordedEpisode,
    ReplayReport,
    read_failed,
    read_manifest,
    read_replay,
    require_passed,
)
from vla_eval.data.tables import EPISODE_TABLES, FRAME_TABLES, Columns
from vla_eval.errors import DatasetError
from vla_eval.features import CAMERA_KEYS, SUCCESS_KEY
from vla_eval.seeding import SeedRange, seed_ranges

UNREADABLE = (
    *(OSError, RuntimeError, ValueError, LookupError, TypeError, OverflowError, MemoryError),
    *(FFmpegError, DecompressionBombError),
)
"""What lerobot, FFmpeg, Pillow and pyarrow raise on damaged content."""
NEEDED = ("meta/info.json", "meta/tasks.parquet", EPISODE_TABLES, FRAME_TABLES)


class LocalDataset:
    """A LeRobotDataset (v3) that is there in full, of any program. Each of its files is read once.

    Raises:
        DatasetError: there is none, or files are missing.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.tables = root, Tables(root)
        check_folder(root)
        if (root / INFO_FILE).is_file():
            _ = self.tables.info  # first: the files of older versions have other names
        for pattern in NEEDED:
            if next(root.glob(pattern), None) is None:
                raise DatasetError(
                    f"{root}: there is no complete LeRobotDataset (v3): no {pattern}. Name the folder of one "
                    f"dataset; `mikasa-vla dataset pull` fetches one from the Hub."
                )

    @property
    def columns(self) -> Columns:
        """Its numbers, frame by frame."""
        return self.tables.columns

    @functools.cached_property
    def meta(self) -> Any:
        """Lerobot's description of it."""
        return self.whole.meta

    @property
    def lengths(self) -> list[int]:
        """The number of frames of each episode."""
        rows = self.meta.episodes
        ends = zip(rows["dataset_from_index"], rows["dataset_to_index"], strict=True)
        return [int(stop) - int(first) for first, stop in ends]

    @functools.cached_property
    def whole(self) -> LeRobotDataset:
        """All of it, with lerobot's default options."""
        return self.lerobot()

    @functools.cached_property
    def in_bytes(self) -> LeRobotDataset:
        """All of it, with images in uint8."""
        return self.lerobot(return_uint8=True)

    def lerobot(self, **options: Any) -> LeRobotDataset:
        """Return lerobot's dataset of these files, checked; `options` are those of `LeRobotDataset`.

        Raises:
            DatasetError: files are damaged, or do not belong together.
        """
        with self.readers():
            return _open(self.root, options)

    def release(self) -> None:
        """Free the frames, once a training's dataset has them; description and columns stay."""
        self.__dict__.pop("whole", None)
        self.tables.__dict__.pop("frames", None)

    def readers(self) -> contextlib.AbstractContextManager[None]:
        """Let lerobot read this dataset from memory."""
        return local_readers(lambda _root: self.tables)


@dataclass(frozen=True, kw_only=True)
class OpenDataset:
    """A complete dataset of this project: what training, cards and mixtures are made from.

    Attributes:
        manifest, failed_seeds, replay: of a recording; empty and None for others.
        local: its tables and videos.
        left_out: numbers of the episodes that are not used.
    """

    root: Path
    facts: Facts
    manifest: tuple[RecordedEpisode, ...]
    failed_seeds: tuple[FailedSeed, ...]
    replay: ReplayReport | None
    local: LocalDataset
    left_out: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.root.resolve().name

    @property
    def sha256(self) -> str:
        """Digest of the digests of all its files."""
        return files_sha256(self.facts.files)

    @property
    def meta(self) -> Any:
        """Lerobot's description of it."""
        return self.local.meta

    @property
    def cameras(self) -> tuple[str, ...]:
        """The images that policies are trained on: ours of tasks, all of an arm."""
        if self.facts.control_mode == MOTORS:
            return tuple(key for key in self.meta.camera_keys if key not in self.meta.depth_keys)
        return tuple(CAMERA_KEYS.values())

    @property
    def columns(self) -> Columns:
        """The numbers of all its episodes, frame by frame."""
        return self.local.columns

    @property
    def columns_used(self) -> Columns:
        """The numbers of the episodes that are used."""
        chosen = ~np.isin(self.columns["episode_index"], self.left_out)
        return {key: values[chosen] for key, values in self.columns.items()}

    @property
    def episodes(self) -> list[int] | None:
        """Numbers of the episodes that are used; None: all."""
        numbers = range(self.meta.total_episodes)
        return sorted(set(numbers) - set(self.left_out)) if self.left_out else None

    @property
    def lengths(self) -> list[int]:
        """The number of frames of each episode that is used."""
        return [n for number, n in enumerate(self.local.lengths) if number not in self.left_out]

    @functools.cached_property
    def failed(self) -> tuple[int, ...]:
        """Numbers of the episodes in which the success rule never held; none if that is not stored."""
        if SUCCESS_KEY not in self.meta.features:
            return ()
        numbers, success = self.columns["episode_index"], self.columns[SUCCESS_KEY].astype(bool)
        return tuple(int(number) for number in np.setdiff1d(numbers, numbers[success.reshape(-1)]))

    @property
    def sentences(self) -> dict[str, tuple[str, ...]]:
        """Task (empty if it is not known) -> the sentences of the episodes that are used."""
        found: dict[str, dict[str, None]] = {}
        for number, (task, sentences) in enumerate(self._spoken):
            if number not in self.left_out:
                found.setdefault(task, {}).update(dict.fromkeys(sentences))
        return {task: tuple(own) for task, own in found.items()}

    @functools.cached_property
    def _spoken(self) -> list[tuple[str, list[str]]]:
        names = self.meta.tasks.index
        episodes, indices = (self.columns[key].astype(np.int64) for key in ("episode_index", "task_index"))
        sources = self.facts.sources if isinstance(self.facts, MixtureFacts) else ()
        tasks = [one.task for one in sources for _ in range(one.n_episodes)]
        spoken = [(task or "", list[str]()) for task in tasks or [self.facts.task] * self.meta.total_episodes]
        for pair in np.unique(episodes * len(names) + indices).tolist():
            episode, sentence = divmod(pair, len(names))
            spoken[episode][1].append(str(names[sentence]))
        return spoken

    @property
    def seeds(self) -> dict[str, tuple[SeedRange, ...]] | None:
        """Task -> the seeds of its episodes, as far as they are known; None for an import."""
        if isinstance(self.facts, MixtureFacts | ArmFacts):
            return self.facts.seeds
        seeds: dict[str, set[int]] = {}
        for episode in self.manifest:
            seeds.setdefault(episode.task, set()).add(episode.seed)
        return {task: seed_ranges(own) for task, own in seeds.items()} or None

    @property
    def seeds_tried(self) -> set[int]:
        """The seeds that demonstrations were tried at, as far as they are known."""
        if isinstance(self.facts, MixtureFacts):
            return {seed for one in self.facts.sources for seed in (*(one.seeds or ()), *one.failed_seeds)}
        return {one.seed for one in self.manifest} | {one.seed for one in self.failed_seeds}

    @property
    def was_replayed(self) -> bool:
        """Whether a replay has confirmed it, which an import cannot have; an error if it found a mismatch."""
        if isinstance(self.facts, MixtureFacts):
            return self.facts.was_replayed
        if not isinstance(self.facts, DatasetFacts):
            return False
        manifest = self.facts.files.get(MANIFEST_FILE.as_posix())
        digest = "" if manifest is None else manifest.sha256
        return require_passed(self.root, self.replay, digest) is not None

    def lerobot(self, **options: Any) -> LeRobotDataset:
        """See `LocalDataset.lerobot`."""
        return self.local.lerobot(**options)


def open_dataset(root: Path) -> OpenDataset:
    """Open a complete dataset of this project, after comparing all of its files with their digests.

    Raises:
        DatasetError: it is not finished, or files are missing or not what they were.
    """
    facts = check_complete(root)
    is_recorded = isinstance(facts, DatasetFacts)
    return OpenDataset(
        root=root,
        facts=facts,
        manifest=read_manifest(root) if is_recorded else (),
        failed_seeds=read_failed(root) if is_recorded else (),
        replay=read_replay(root) if is_recorded else None,
        local=LocalDataset(root),
    )


def open_local_dataset(root: Path, **options: Any) -> LeRobotDataset:
    """Return lerobot's dataset of a folder; see `LocalDataset`."""
    return LocalDataset(root).lerobot(**options)


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
def local_readers(tables_of: Callable[[Path], Tables]) -> Iterator[None]:
    """Let lerobot read by our readers, which know no address, and ask the Hub for nothing.

    `tables_of` returns what the files of a folder hold; lerobot gets copies of what it changes.
    """

    def frames(folder: Path, features: Any, episodes: Sequence[int] | None = None) -> Any:
        return frames_for_lerobot(tables_of(folder.parent).frames, features, episodes)

    def info(root: Path) -> DatasetInfo:
        return DatasetInfo.from_dict(copy.deepcopy(tables_of(root).info))

    replaced = (
        (dataset_metadata, "load_info", info),
        (dataset_metadata, "load_episodes", lambda root: tables_of(root).episodes),
        (dataset_metadata, "load_tasks", lambda root: tables_of(root).tasks.copy()),
        (dataset_metadata, "load_stats", lambda root: copy.deepcopy(tables_of(root).statistics)),
        (dataset_metadata, "get_safe_version", _refuse_hub),
        (dataset_reader, "load_nested_dataset", frames),
        (LeRobotDatasetMetadata, "_pull_from_repo", _refuse_hub),
        (LeRobotDataset, "_download", _refuse_hub),
    )
    with contextlib.ExitStack() as stack:
        for owner, name, ours in replaced:
            stack.enter_context(patch.object(owner, name, ours))
        yield


def join_datasets(roots: Sequence[Path], root: Path, **options: Any) -> None:
    """Put datasets together as a new one, by lerobot's `aggregate_datasets`.

    Raises:
        ValueError: they do not have the same fields.
    """
    with local_readers(Tables):
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
    """Return lerobot's decoder: the path that torchcodec gets is fsspec's, where `::` chains addresses."""
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
