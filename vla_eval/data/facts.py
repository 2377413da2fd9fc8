"""What a dataset of this project is: a file in `meta/mikasa/`, written last. Knows nothing of lerobot."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar  # Any: plain data

from vla_eval.control_modes import MOTORS
from vla_eval.data.folder_contents import check_folder
from vla_eval.data.manifest import (
    ARM_FILE,
    FETCH_AGAIN,
    IMPORT_FILE,
    MIXTURE_FILE,
    RECORDING_FILE,
    ArmEpisode,
    FileDigest,
    from_json,
    read_content,
)
from vla_eval.errors import DatasetError
from vla_eval.robots.find import control_mode_of
from vla_eval.seeding import SeedRange, seed_ranges
from vla_eval.strict.json_text import Count, Positive, shown

MAX_NAME = 255  # bytes; what file systems take


@dataclass(frozen=True, slots=True, kw_only=True)
class DatasetFacts:
    """What a recorded dataset is, and how it came about; for the rest see `Facts`."""

    complete: bool
    # `name`, `recipe`: of the resolved recipe; `recipe_sha256` is the digest of what content depends on
    name: str
    task: str
    task_version: Positive
    instruction: str
    state: str
    n_episodes: Count
    n_frames: Count
    n_failed_seeds: Count
    recipe: dict[str, Any]
    recipe_sha256: str
    recipe_files: dict[str, str]  # `policies/oracle` -> sha256 of the file; likewise prompts and weights
    environment: dict[str, Any]  # commit, versions and machine, see `provenance.collect_environment`
    device: dict[str, str]  # the device that rendered, as the environment describes it
    files: dict[str, FileDigest]
    is_checked: ClassVar[bool] = True
    kept: ClassVar[tuple[str, ...]] = ()

    @property
    def tasks(self) -> tuple[str, ...]:
        """Its one task."""
        return (self.task,)

    @property
    def control_mode(self) -> str:
        """What the actions are for."""
        env = self.recipe.get("env")
        return control_mode_of(env if isinstance(env, dict) else {})

    @property
    def kind(self) -> str:
        """What it is, for a person."""
        return f"a recording of {self.task}, complete"


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportedEpisode:
    """What the source of an import says about an episode."""

    name: str  # its file, or its number in the source
    n_steps: Positive
    instruction: str
    source_seed: int | None  # its seed in the source's environment; ours gives another episode for it
    success: bool | None  # whether the source's success flag holds at any frame; None if it has none


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportFacts:
    """What a converted dataset is, where it came from, and what it lacks; for the rest see `Facts`."""

    complete: bool
    source_layout: str  # see `foreign.episodes.Layout`; or `adopted`, if the files are those of the source
    task: str | None
    instruction_source: str  # where the instruction comes from: `source`, or the prompt set of the task
    state: str
    control_mode: str
    executable_by_pd_ee_delta_pose: bool  # whether this project's environments can execute the actions
    absent: tuple[str, ...]  # fields of our own datasets that the source lacks
    left_out: tuple[str, ...]  # arrays that were not taken over
    n_frames: Count
    episodes: tuple[ImportedEpisode, ...]
    source_files: dict[str, FileDigest]
    files: dict[str, FileDigest]
    vla_eval_version: str
    is_checked: bool = False  # False for what an older version wrote
    converted: tuple[str, ...] = ()  # what was changed because it was asked for, a sentence each
    kept: tuple[str, ...] = ()

    @property
    def tasks(self) -> tuple[str, ...]:
        """Its task, if one was named."""
        return () if self.task is None else (self.task,)

    @property
    def kind(self) -> str:
        """What it is, for a person."""
        made = "adopted dataset" if self.source_layout == "adopted" else f"import from {self.source_layout}"
        return f"an {made}, complete"


@dataclass(frozen=True, slots=True, kw_only=True)
class MixtureSource:
    """A dataset of one task, whose episodes follow those of the sources before it."""

    name: str
    # `task`, `task_version`: None for an import that names none
    task: str | None
    task_version: Positive | None
    instructions: tuple[str, ...]  # every sentence that occurs in it
    n_episodes: Positive
    n_frames: Positive
    sha256: str  # digest of the digests of all its files
    # of its episodes, in their order; None for an import, whose seeds are not ours
    seeds: tuple[Count, ...] | None
    failed_seeds: tuple[Count, ...]
    was_replayed: bool  # whether a replay had confirmed it when it was mixed


@dataclass(frozen=True, slots=True, kw_only=True)
class MixtureFacts:
    """What a dataset of several tasks is, with its sources in their order; for the rest see `Facts`."""

    complete: bool
    state: str
    control_mode: str
    sources: tuple[MixtureSource, ...]
    files: dict[str, FileDigest]
    vla_eval_version: str
    is_checked: ClassVar[bool] = False  # its sources are; the whole is checked when it is used
    kept: ClassVar[tuple[str, ...]] = ()

    @property
    def tasks(self) -> tuple[str, ...]:
        """The task ids, each once, in the order of the sources."""
        return tuple(dict.fromkeys(one.task for one in self.sources if one.task is not None))

    @property
    def task(self) -> str | None:
        """The task of all sources; None if they are of several, or one names none."""
        named = {one.task for one in self.sources}
        return self.sources[0].task if len(named) == 1 else None

    @property
    def seeds(self) -> dict[str, tuple[SeedRange, ...]] | None:
        """Task -> the seeds of its episodes, as far as they are known; None if none are."""
        known: dict[str, list[int]] = {}
        for one in self.sources:
            if one.task is not None and one.seeds is not None:
                known.setdefault(one.task, []).extend(one.seeds)
        return {task: seed_ranges(own) for task, own in known.items()} or None

    @property
    def shared_scenes(self) -> tuple[str, ...]:
        """A sentence for each two sources that have seeds of one task's rules in common: the same scenes."""
        found = []
        for one, other in combinations(self.sources, 2):
            if one.task is None or (one.task, one.task_version) != (other.task, other.task_version):
                continue
            common = sorted(set(one.seeds or ()) & set(other.seeds or ()))
            if common:
                found.append(
                    f"{one.name} and {other.name} share {len(common)} seeds of {one.task}, from "
                    f"{common[0]} to {common[-1]}: these scenes count twice."
                )
        return tuple(found)

    @property
    def n_frames(self) -> int:
        """Of all sources."""
        return sum(one.n_frames for one in self.sources)

    @property
    def was_replayed(self) -> bool:
        """Whether a replay had confirmed every source."""
        return all(one.was_replayed for one in self.sources)

    @property
    def kind(self) -> str:
        """What it is, for a person."""
        return f"a mixture of {len(self.sources)} datasets, complete"


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmFacts:
    """Demonstrations on an arm, and how they came about; for the rest see `Facts`."""

    complete: bool
    task: str
    robot: str  # LeRobot's type
    settings: dict[str, Any]  # how the arm was driven, see `RobotSettings.content`
    # `leader`: what led it, LeRobot's type or `scripted`; `teleop`: LeRobot's fields of it
    leader: str
    teleop: dict[str, Any]
    n_frames: Count
    n_discarded: Count  # episodes without success that were not kept
    episodes: tuple[ArmEpisode, ...]
    environment: dict[str, Any]  # see `provenance.collect_environment`
    files: dict[str, FileDigest]
    vla_eval_version: str
    state: ClassVar[str] = MOTORS
    control_mode: ClassVar[str] = MOTORS
    is_checked: ClassVar[bool] = True
    kept: ClassVar[tuple[str, ...]] = ()

    @property
    def tasks(self) -> tuple[str, ...]:
        """Its one task."""
        return (self.task,)

    @property
    def seeds(self) -> dict[str, tuple[SeedRange, ...]]:
        """Task -> the seeds of its trials."""
        return {self.task: seed_ranges(one.seed for one in self.episodes)}

    @property
    def kind(self) -> str:
        """What it is, for a person."""
        return f"demonstrations of {self.task} on {self.robot}, complete"


type Facts = DatasetFacts | ImportFacts | MixtureFacts | ArmFacts
"""What a dataset is. All kinds have these:

    complete      written as true, after everything else
    task          the task id of all episodes; None if there are several, or it is not known
    tasks         all task ids that are known
    state         which proprioception `observation.state` is
    control_mode  what the actions are for
    n_frames      of all episodes
    files         path below the dataset -> digest
    is_checked    whether the rules of `checks.rules` were applied when it was made
    kept          what was then found and kept
    kind          what it is, for a person
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of dataset: its facts and their file; for messages, how it was made, resumed and repaired."""

    cls: type[Facts]
    file: Path
    made: str
    again: str
    repair: str


KINDS = (
    Kind(
        cls=DatasetFacts,
        file=RECORDING_FILE,
        made="recorded",
        again="Run the command that records it again: it resumes.",
        repair="Fetch or record the dataset again, or make it from its manifest: `mikasa-vla replay DATASET "
        "--rebuild OUT`.",
    ),
    Kind(
        cls=ImportFacts,
        file=IMPORT_FILE,
        made="converted",
        again="Convert the source again.",
        repair="Convert the source again.",
    ),
    Kind(
        cls=MixtureFacts,
        file=MIXTURE_FILE,
        made="mixed",
        again="Mix its sources again.",
        repair="Mix its sources again.",
    ),
    Kind(
        cls=ArmFacts,
        file=ARM_FILE,
        made="recorded",
        again="Run the command that records it again: it resumes.",
        repair="Fetch the dataset again.",
    ),
)
"""In the order in which they are looked for."""


def kind_of(facts: Facts) -> Kind:
    """Return the kind of a dataset."""
    return next(kind for kind in KINDS if isinstance(facts, kind.cls))


def has_facts(root: Path) -> bool:
    """Whether a folder has the records of a dataset of this project."""
    return any((root / kind.file).exists() for kind in KINDS)


def find_facts(root: Path) -> Facts | None:
    """Return what a dataset of this project is, or raise `DatasetError`; None if it is another one."""
    for kind in KINDS:
        if (root / kind.file).exists():
            return _read(root, kind)
    return None


def read_facts(root: Path) -> DatasetFacts:
    """Return what a recorded dataset is; `DatasetError` if it is another one, or was not finished."""
    check_folder(root)
    facts = _read(root, KINDS[0])
    assert isinstance(facts, DatasetFacts)
    return facts


def files_sha256(files: Mapping[str, FileDigest]) -> str:
    """Return one digest for all files of a dataset."""
    lines = (f"{name}\0{digest.sha256}\n" for name, digest in sorted(files.items()))
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _read(root: Path, kind: Kind) -> Facts:
    path = root / kind.file
    facts: Facts = from_json(kind.cls, read_content(path), where=str(path))
    for name in facts.files:
        parts = PurePosixPath(name).parts
        is_inside = bool(parts) and not name.startswith("/") and ".." not in parts
        if not is_inside or not name.isprintable() or max(len(part.encode()) for part in parts) > MAX_NAME:
            raise DatasetError(
                f"{path}: expected names of files inside of the dataset, found {shown(name)}. {FETCH_AGAIN}"
            )
    if not facts.complete:
        raise DatasetError(f"{root}: is not complete. {kind.again}")
    return facts
