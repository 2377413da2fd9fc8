"""What a fine-tuning reads from a dataset, which has to be complete and replayed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any  # lerobot is untyped

import numpy as np

from vla_eval.control_modes import CONTROL_MODES
from vla_eval.data.check import require_checked
from vla_eval.data.completeness import check_complete, files_sha256
from vla_eval.data.dataset_folder import open_recorded
from vla_eval.data.imported import ImportFacts
from vla_eval.data.info_file import one_dataset
from vla_eval.data.manifest import DatasetFacts, read_manifest
from vla_eval.data.mixture import MixtureFacts
from vla_eval.data.opening import open_local_dataset
from vla_eval.data.replaying.report import require_passed
from vla_eval.data.tables import read_columns
from vla_eval.errors import DatasetError
from vla_eval.features import CAMERA_KEYS, SUCCESS_KEY
from vla_eval.seeding import SeedRange, seed_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingDataset:
    """A dataset that may be trained on.

    Attributes:
        root: its folder.
        name: the folder's name.
        sha256: digest of the digests of all its files.
        task: task id; empty for an import that names none, and for several tasks.
        tasks: all task ids.
        state, control_mode: see `TrainingFacts`.
        was_replayed: whether a replay has confirmed it.
        seeds: see `TrainingFacts`.
        meta: lerobot's description of it.
        spoken: of each episode, its task (empty if it is not known) and its sentences.
        failed: numbers of the episodes in which the success rule never held; empty, too, if that is not
            stored.
        left_out: numbers of the episodes that are not trained on.
    """

    root: Path
    name: str
    sha256: str
    task: str
    tasks: tuple[str, ...]
    state: str
    control_mode: str
    was_replayed: bool
    seeds: dict[str, tuple[SeedRange, ...]] | None
    meta: Any
    spoken: tuple[tuple[str, tuple[str, ...]], ...] = ()
    failed: tuple[int, ...] = ()
    left_out: tuple[int, ...] = ()

    @property
    def episodes(self) -> list[int] | None:
        """Numbers of the episodes that are trained on; None: all."""
        left_out = set(self.left_out)
        return [i for i in range(self.meta.total_episodes) if i not in left_out] if left_out else None

    @property
    def sentences(self) -> dict[str, tuple[str, ...]]:
        """See `TrainingFacts`; of the episodes that are trained on."""
        left_out = set(self.left_out)
        found: dict[str, dict[str, None]] = {}
        for number, (task, sentences) in enumerate(self.spoken):
            if number not in left_out:
                found.setdefault(task, {}).update(dict.fromkeys(sentences))
        return {task: tuple(own) for task, own in found.items()}

    @property
    def lengths(self) -> list[int]:
        """The number of frames of each episode that is trained on."""
        rows = self.meta.episodes
        ends = list(zip(rows["dataset_from_index"], rows["dataset_to_index"], strict=True))
        chosen = range(len(ends)) if self.episodes is None else self.episodes
        return [int(ends[i][1]) - int(ends[i][0]) for i in chosen]


def training_dataset(root: Path, *, allow_unreplayed: bool) -> TrainingDataset:
    """Return a dataset that is complete and, unless that is waived, was replayed without a mismatch.

    Args:
        root: the folder of a dataset, or a folder that holds exactly one.
        allow_unreplayed: return it although no replay has confirmed it.

    Raises:
        DatasetError: it is not, or the folder holds several.
    """
    root = one_dataset(root)
    facts = check_complete(root)
    was_replayed = _was_replayed(root, facts)
    if not was_replayed and not allow_unreplayed:
        way = _to_replay(root, facts)
        raise DatasetError(
            f"{root}: no replay has confirmed this dataset: it is not known whether its actions lead to what "
            f"its images show. {way}; or train on it all the same with --allow-unreplayed, which is noted "
            f"in the run."
        )
    if facts.control_mode not in CONTROL_MODES:
        raise DatasetError(
            f"{root}: its actions are for '{facts.control_mode}', which the environments here do not "
            f"execute (they take {', '.join(CONTROL_MODES)}). A policy that is trained on it could not be "
            f"evaluated."
        )
    opened = open_recorded(root) if isinstance(facts, DatasetFacts) else open_local_dataset(root)
    require_checked(opened, facts)
    missing = [key for key in CAMERA_KEYS.values() if key not in opened.meta.features]
    if missing:
        raise DatasetError(f"{root}: expected the images {', '.join(missing)}, found none of that name.")
    tasks = facts.tasks if isinstance(facts, MixtureFacts) else (facts.task,) if facts.task else ()
    return TrainingDataset(
        root=root,
        name=root.resolve().name,
        sha256=files_sha256(facts.files),
        task=facts.task or "",
        tasks=tasks,
        state=facts.state,
        control_mode=facts.control_mode,
        was_replayed=was_replayed,
        seeds=_seeds(root, facts),
        meta=opened.meta,
        spoken=_spoken(root, facts, opened.meta),
        failed=_failed(root) if SUCCESS_KEY in opened.meta.features else (),
    )


def _failed(root: Path) -> tuple[int, ...]:
    columns = read_columns(root)
    numbers, success = columns["episode_index"], columns[SUCCESS_KEY].astype(bool)
    return tuple(int(number) for number in np.setdiff1d(numbers, numbers[success]))


def demonstrated_seeds(root: Path) -> dict[str, tuple[SeedRange, ...]]:
    """Return task -> the seeds of the episodes that a recorded dataset holds.

    Raises:
        DatasetError: see `read_manifest`.
    """
    seeds: dict[str, set[int]] = {}
    for episode in read_manifest(root):
        seeds.setdefault(episode.task, set()).add(episode.seed)
    return {task: seed_ranges(own) for task, own in seeds.items()}


def _seeds(
    root: Path, facts: DatasetFacts | ImportFacts | MixtureFacts
) -> dict[str, tuple[SeedRange, ...]] | None:
    if isinstance(facts, MixtureFacts):
        return facts.seeds
    return demonstrated_seeds(root) if isinstance(facts, DatasetFacts) else None


def _spoken(
    root: Path, facts: DatasetFacts | ImportFacts | MixtureFacts, meta: Any
) -> tuple[tuple[str, tuple[str, ...]], ...]:
    columns, names = read_columns(root, ("episode_index", "task_index")), meta.tasks.index
    episodes, indices = (columns[name].astype(np.int64) for name in ("episode_index", "task_index"))
    pairs = np.unique(episodes * len(names) + indices)
    sources = facts.sources if isinstance(facts, MixtureFacts) else ()
    tasks = [one.task for one in sources for _ in range(one.n_episodes)] or [facts.task] * meta.total_episodes
    sentences: list[list[str]] = [[] for _ in tasks]
    for pair in pairs.tolist():
        episode, sentence = divmod(pair, len(names))
        sentences[episode].append(str(names[sentence]))
    return tuple((task or "", tuple(own)) for task, own in zip(tasks, sentences, strict=True))


def _was_replayed(root: Path, facts: DatasetFacts | ImportFacts | MixtureFacts) -> bool:
    """Whether a replay has confirmed a dataset; an import cannot be replayed.

    Raises:
        DatasetError: a replay found a mismatch.
    """
    if isinstance(facts, MixtureFacts):
        return facts.was_replayed
    return isinstance(facts, DatasetFacts) and require_passed(root) is not None


def _to_replay(root: Path, facts: DatasetFacts | ImportFacts | MixtureFacts) -> str:
    if isinstance(facts, ImportFacts):
        return "It was imported and cannot be replayed"
    if isinstance(facts, DatasetFacts):
        return f"Run mikasa-vla replay {root}"
    names = ", ".join(source.name for source in facts.sources if not source.was_replayed)
    return f"Of what it was mixed of, {names} had not been replayed: replay these and mix again"
