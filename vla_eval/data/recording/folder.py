"""What a recording keeps while it runs, so that it can be stopped at any moment.

    OUT/TASK/                            a finished dataset; appears in one step
    OUT/recording/run.json               recipe and environment it was started with, and each continuation
    OUT/recording/TASK/attempts.jsonl    one `Attempt` per line, in the order they came
    OUT/recording/TASK/shards/shard-00000  finished shards; removed once the dataset is there
    OUT/recording/logs/worker-0.log      what workers wrote
    OUT/recording/recording.lock         held by the process that records

Only the parent process writes here, but for shards and datasets. Knows nothing of what they hold.
"""

import dataclasses
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from vla_eval.data.recording.demonstrations import Attempt
from vla_eval.errors import DatasetError, RunFolderError
from vla_eval.lock.switch import let_write
from vla_eval.storage.continuing import check_allowed, continued, device_changes, known_device
from vla_eval.storage.durable import LineFile, cut_tail, read_lines, sync_path, whole_lines
from vla_eval.storage.folders import other_files
from vla_eval.storage.run_file import RUN_FILE, RunDescription, RunFile
from vla_eval.storage.starting import StartedFolder, starting
from vla_eval.strict.json_text import Source, as_dataclass, read_json

STATE_FOLDER = "recording"
LOCK_FILE = "recording.lock"
ATTEMPTS_FILE = "attempts.jsonl"
SHARDS = "shards"
_OWN_FILES = (RUN_FILE, f"{RUN_FILE}.tmp", LOCK_FILE)  # of a recording that has no attempt yet


class RecordingFolder:
    """The folder of a recording that this process writes into; make it with `open`."""

    def __init__(self, out: Path, started: StartedFolder, run_file: RunFile) -> None:
        """Use `open`."""
        self.out = out
        self._started = started
        self.run_file = run_file
        self._attempts: dict[str, LineFile] = {}

    @classmethod
    def open(cls, out: Path, description: RunDescription, *, allow_environment_change: bool) -> Self:
        """Start a recording in a folder, or resume the one that is there."""
        state = out / STATE_FOLDER
        let_write(out)

        with starting(
            state,
            own=_OWN_FILES,
            lock_file=LOCK_FILE,
            purpose="the folder of a recording",
            check=lambda _state: _refuse_foreign(out),
        ) as started:
            run_file = continued(
                state, description, shown=out, allow_environment_change=allow_environment_change
            )
            run_file.save(state)
            sync_path(out)
        return cls(out, started, run_file)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, value: BaseException | None, *_: object) -> None:
        """Close the files and let other processes in; a start that failed leaves nothing behind."""
        for file in self._attempts.values():
            file.close()
        self._attempts = {}
        self._started.leave(failed=isinstance(value, Exception))

    def note_device(self, device: Mapping[str, str], *, allow_change: bool) -> None:
        """Record the device: all images of a dataset come from one, or `RunChangedError` is raised."""
        changes = device_changes(self.run_file, device)
        check_allowed(changes, shown=self.out, allowed=allow_change)
        known = known_device(self.run_file)
        if dict(device) != known:
            self.run_file = self.run_file.with_device({**known, **device}, changes)
            self.run_file.save(self.out / STATE_FOLDER)

    def logs(self) -> Path:
        """Return the folder of the workers' logs."""
        return _made(self.out / STATE_FOLDER / "logs")

    def shard(self, task: str, index: int) -> Path:
        """Return where a shard appears."""
        path = shard_path(self.out, task, index)
        _made(path.parent)
        return path

    def attempts(self, task: str) -> dict[int, Attempt]:
        """Return seed -> attempt; errors as `read_attempts`."""
        cut_tail(self._task_folder(task) / ATTEMPTS_FILE)
        return read_attempts(self.out, task)

    def append(self, task: str, attempt: Attempt) -> None:
        """Keep an attempt; it is durable when this returns."""
        if task not in self._attempts:
            self._attempts[task] = LineFile(self._task_folder(task) / ATTEMPTS_FILE, durable=True)
        self._attempts[task].append(json.dumps(dataclasses.asdict(attempt)))

    def _task_folder(self, task: str) -> Path:
        return _made(self.out / STATE_FOLDER / task)


def read_attempts(out: Path, task: str) -> dict[int, Attempt]:
    """Return seed -> attempt of a recording, without touching it, or raise `DatasetError`."""
    path = out / STATE_FOLDER / task / ATTEMPTS_FILE
    found = [_attempt(line, where=where) for line, where in whole_lines(read_lines(path), path)]
    return {one.seed: one for one in found}


def shard_path(out: Path, task: str, index: int) -> Path:
    """Return where a shard of a recording is, or would be."""
    return out / STATE_FOLDER / task / SHARDS / f"shard-{index:05d}"


def remove_shards(out: Path, task: str) -> None:
    """Remove the shards of a recording, which are not needed once the dataset is there."""
    shutil.rmtree(out / STATE_FOLDER / task / SHARDS, ignore_errors=True)


def _refuse_foreign(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise RunFolderError(f"{out}: expected a folder, found a file. Use another --out.")
    if not out.exists() or (out / STATE_FOLDER).exists():
        return
    if names := os.listdir(out):
        raise other_files(out, names, missing="recording", error=RunFolderError)


def _attempt(line: bytes, *, where: str) -> Attempt:
    remedy = "The file was changed by another program; restore it or record into another --out."
    source = Source(where=where, what="an attempt", remedy=remedy, error=DatasetError)
    return as_dataclass(Attempt, read_json(line, source), source)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
