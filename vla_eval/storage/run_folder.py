"""The run folder: episodes are durable when they are reported as finished, and none is counted twice.

    run.json        what the run consists of, and each time it was continued or grew (see `run_file`)
    episodes.jsonl  one `EpisodeRecord` per line, appended, never rewritten
    timings.jsonl   wall-clock seconds, one `EpisodeTiming` per line; no result depends on it
    run.lock        held by the process that writes

Knows nothing of tasks, policies or statistics.
"""

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Self

from vla_eval.errors import RunFolderError
from vla_eval.records import EpisodeKey, EpisodeRecord, EpisodeTiming
from vla_eval.storage.continuing import check_allowed, continued, device_changes, known_device
from vla_eval.storage.durable import LineFile, cut_tail, read_lines, sync_path
from vla_eval.storage.episodes_file import parse_records, repair_records, shown_key
from vla_eval.storage.folders import (
    EPISODES_FILE,
    LOCK_FILE,
    RUN,
    TIMINGS_FILE,
    check_folder,
    kind_of,
    not_a_run_folder,
)
from vla_eval.storage.planned import PlannedEpisodes
from vla_eval.storage.run_file import (
    DEVICE,
    RUN_FILE,
    JsonValue,
    RunDescription,
    RunFile,
    Session,
    find_changes,
)
from vla_eval.storage.starting import StartedFolder, starting

__all__ = ["JsonValue", "RunDescription", "RunFolder", "Session", "StoredRun", "read_run"]

logger = logging.getLogger(__name__)

_OWN_FILES = (RUN_FILE, f"{RUN_FILE}.tmp", EPISODES_FILE, TIMINGS_FILE, LOCK_FILE)


class StoredEpisode(NamedTuple):
    """A record, and how long the episode took, where that is known."""

    record: EpisodeRecord
    timing: EpisodeTiming | None


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredRun:
    """What a run folder holds; of each key the success or failure if there is one, else the last error."""

    path: Path
    description: RunDescription
    records: tuple[EpisodeRecord, ...]
    sessions: tuple[Session, ...] = ()


class RunFolder:
    """A run folder that this process writes into; make it with `RunFolder.open`.

    It is a context manager. Only one process at a time can have it open; that ends with the process.
    """

    def __init__(
        self,
        path: Path,
        description: RunDescription,
        *,
        allow_environment_change: bool,
        groups: Collection[tuple[str, str, int]] | None,
    ) -> None:
        """Use `open`: this is called with the folder locked."""
        self.path = path
        self._allow_environment_change = allow_environment_change
        self._started: StartedFolder | None = None
        self._run_file = self._load(description)
        self._planned = self._run_file.planned(path, groups)
        records = repair_records(path / EPISODES_FILE, self._planned)
        self._finished = {key for key, record in records.items() if record.outcome != "error"}
        self._has_lines = bool(records)
        cut_tail(path / TIMINGS_FILE)
        # run.json comes first: episodes without it would belong to no run.
        self._run_file.save(path)
        self._episodes: LineFile | None = LineFile(path / EPISODES_FILE, durable=True)
        self._timings = LineFile(path / TIMINGS_FILE, durable=False)
        sync_path(path)

    @classmethod
    def open(
        cls,
        path: Path,
        description: RunDescription,
        *,
        allow_environment_change: bool = False,
        groups: Collection[tuple[str, str, int]] | None = None,
    ) -> Self:
        """Start a run in a new or empty folder, or continue the one that is there.

        Args:
            path: the folder.
            description: what the run is started with; it must be what it was before, or plan more episodes.
            allow_environment_change: continue although commit, versions or device have changed.
            groups: task, policy and n_action_steps of each episode that is planned; None: as far as the
                description says it.

        Raises:
            RunChangedError: configuration, recipes or environment are not what they were.
            RunFolderError: another process has it open, its files are damaged, it holds episodes that are
                not planned, or it is somebody else's.
            StorageFullError: the disk is full.
        """
        with starting(
            path, own=_OWN_FILES, lock_file=LOCK_FILE, purpose="a run folder", check=check_folder
        ) as started:
            folder = cls(path, description, allow_environment_change=allow_environment_change, groups=groups)
        folder._started = started
        return folder

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, exc: BaseException | None, *_: object) -> None:
        """Close the folder; a new one is removed if an error came before its first episode."""
        if isinstance(exc, Exception) and self._started is not None and not self._has_lines:
            self._started.undo()
        self.close()

    def finished_keys(self) -> frozenset[EpisodeKey]:
        """Return the keys of all episodes with a result. Errors have none, so they are run again."""
        return frozenset(self._finished)

    def append(self, record: EpisodeRecord, timing: EpisodeTiming | None = None) -> None:
        """Store one episode; it is durable when this returns. A timing may be lost without an error.

        Raises:
            RunFolderError: the episode has a result already or is not planned, its values contradict each
                other, or the folder is closed.
            StorageFullError: it could not be stored; the folder is as it was before.
        """
        self.append_all([StoredEpisode(record, timing)])

    def append_all(self, episodes: Sequence[StoredEpisode]) -> None:
        """Store several episodes at once; all are durable when this returns. For the errors see `append`."""
        sound: list[StoredEpisode] = []
        keys: set[EpisodeKey] = set()
        try:
            for episode in episodes:
                self._check(episode.record, keys)
                sound.append(episode)
                keys.add(episode.record.key)
        finally:
            self._write(sound)

    def _check(self, record: EpisodeRecord, others: Collection[EpisodeKey]) -> None:
        if self._episodes is None:
            raise RunFolderError(f"{self.path}: the run folder is closed. Open it again before appending.")
        if record.outcome != "error" and (record.key in self._finished or record.key in others):
            raise RunFolderError(
                f"{self.path}: {shown_key(record.key)} has a result already; a second one would be counted "
                f"twice. Skip the keys in finished_keys()."
            )
        objection = self._planned.objection(record)
        if objection is not None:  # or the folder could not be read again
            raise RunFolderError(
                f"{self.path}: expected an episode that this run plans, got {shown_key(record.key)}: "
                f"{objection}. Nothing was stored."
            )
        record.check(where=f"{self.path}: {shown_key(record.key)}")  # or nobody could read the folder again

    def _write(self, episodes: Sequence[StoredEpisode]) -> None:
        if not episodes or self._episodes is None:
            return
        self._has_lines = True  # also if the line could not be written as a whole
        self._episodes.append_all([record.to_json() for record, _ in episodes])
        self._finished.update(record.key for record, _ in episodes if record.outcome != "error")
        timings = [timing.to_json() for _, timing in episodes if timing is not None]
        try:
            self._timings.append_all(timings)
        except RunFolderError as exc:
            logger.warning("%s: %d timings were not kept (%s)", self.path, len(timings), exc)

    def note_machine(self, kind: str, facts: Mapping[str, JsonValue]) -> None:
        """Record that episodes run on a machine of another kind; errors as `note_device`."""
        environment = self._run_file.description.environment
        own = {name: environment.get(name) for name in facts}
        changes = find_changes(own, facts, prefix=f"environment.machine {kind}")
        check_allowed(changes, shown=self.path, allowed=self._allow_environment_change)
        self._keep(self._run_file.with_changes(changes))

    def note_device(self, device: Mapping[str, JsonValue]) -> None:
        """Record facts about the device; `RunChangedError` if known ones have changed."""
        self._keep(self._with_device(self._run_file, device))

    def note(self, line: str) -> None:
        """Record what tables quote: what a tokenizer made of an instruction, how a network was compiled."""
        if not any(line in session.sentences for session in self._run_file.sessions):
            self._keep(self._run_file.with_sentence(line))

    def note_memory(self, policy: str, parts: tuple[str, ...]) -> None:
        """Record the parts of a policy's memory."""
        self._keep(self._run_file.with_memory(policy, parts))

    def close(self) -> None:
        """Close the files and let other processes in; a second call does nothing."""
        if self._episodes is not None:
            self._episodes.close()
            self._timings.close()
            self._episodes = None
        if self._started is not None:
            self._started.leave(failed=False)
            self._started = None

    def _load(self, description: RunDescription) -> RunFile:
        run_file = continued(
            self.path,
            description,
            shown=self.path,
            allow_environment_change=self._allow_environment_change,
            may_grow=True,
        )
        device = description.environment.get(DEVICE)
        return self._with_device(run_file, device) if isinstance(device, Mapping) else run_file

    def _with_device(self, run_file: RunFile, device: Mapping[str, JsonValue]) -> RunFile:
        changes = device_changes(run_file, device)
        check_allowed(changes, shown=self.path, allowed=self._allow_environment_change)
        recorded = known_device(run_file)
        if not changes and device.keys() <= recorded.keys():
            return run_file
        return run_file.with_device({**device, **recorded}, changes)

    def _keep(self, updated: RunFile) -> None:
        if updated != self._run_file:
            updated.save(self.path)
            self._run_file = updated


def read_run(path: Path) -> StoredRun:
    """Read a run folder without touching it; a run may be writing to it.

    Raises:
        RunFolderError: it is not a run folder, or a file in it is damaged.
    """
    if kind_of(path) != RUN:
        raise not_a_run_folder(path)
    run_file = RunFile.load(path)
    return StoredRun(
        path=path,
        description=run_file.description,
        records=_whole_records(path, run_file.planned(path)),
        sessions=run_file.sessions,
    )


def _whole_records(path: Path, planned: PlannedEpisodes) -> tuple[EpisodeRecord, ...]:
    data = read_lines(path / EPISODES_FILE)
    # What follows the last newline is being written at this moment, or was when its writer was killed.
    return tuple(parse_records(data[: data.rfind(b"\n") + 1], path / EPISODES_FILE, planned).values())


def check_startable(
    path: Path,
    description: RunDescription,
    *,
    allow_environment_change: bool,
    groups: Collection[tuple[str, str, int]],
) -> tuple[EpisodeRecord, ...]:
    """Refuse what `RunFolder.open` would refuse, and write nothing; return the records that are there."""
    check_folder(path)
    run_file = continued(
        path, description, shown=path, allow_environment_change=allow_environment_change, may_grow=True
    )
    return _whole_records(path, run_file.planned(path, groups))
