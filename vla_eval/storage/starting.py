"""Start to write into a folder: make it, lock it, and leave nothing behind if the start fails."""

import contextlib
import logging
import os
import shutil
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from vla_eval.errors import RunFolderError
from vla_eval.lock.switch import let_write
from vla_eval.storage.durable import DISK_TROUBLE, FolderLock, storage_full

logger = logging.getLogger(__name__)

LOGS_FOLDER = "logs"
RUNS_FOLDER = Path("runs")  # run folders without a name of their own are made in it


class StartedFolder:
    """A folder that this process makes or finds, and locks; the start writes the files of `own` into it."""

    def __init__(self, path: Path, *, own: Collection[str]) -> None:
        self._path = path
        self._own = frozenset(own)
        self._made = [folder for folder in (path, *path.parents) if not folder.exists()]
        self._before = frozenset(os.listdir(path)) if path.is_dir() else frozenset[str]()
        self._lock: FolderLock | None = None

    def lock(self, file: str) -> None:
        """Keep other processes out; a `FolderInUseError` if one is in it."""
        self._lock = FolderLock(self._path / file)

    def leave(self, *, failed: bool) -> None:
        """Let others in; what is new is removed if nothing came of it."""
        if failed:
            self.undo()
        if self._lock is not None:
            self._lock.release()

    def undo(self) -> None:
        """Remove what the start has made; nothing, if there is anything that it does not know."""
        try:
            self._undo()
        except OSError as exc:  # the error that ended the start says more
            logger.warning("%s: what a failed start has made could not be removed (%s)", self._path, exc)

    def _undo(self) -> None:
        if not self._path.is_dir():
            return
        new = [self._path / name for name in sorted(set(os.listdir(self._path)) - self._before)]
        folders = [entry for entry in new if entry.is_dir() and not entry.is_symlink()]
        files = [entry for entry in new if entry not in folders]
        known = self._own.issuperset(file.name for file in files)
        if not known or not all(map(_is_of_start, folders)):
            return
        for file in files:
            file.unlink()
        for folder in folders:
            shutil.rmtree(folder)
        for folder in self._made:  # the innermost first
            if any(folder.iterdir()):  # somebody else has begun to use it
                return
            folder.rmdir()


@contextlib.contextmanager
def starting(
    path: Path,
    *,
    own: Collection[str],
    lock_file: str,
    purpose: str,
    check: Callable[[Path], object] = lambda _path: None,
) -> Iterator[StartedFolder]:
    """Make and lock a folder; if the block ends with an exception, all that was made is removed.

    `own` are the files that a start writes into it, `purpose` is `a run folder`, for messages, and `check`
    refuses what is there already.
    """
    let_write(path)
    try:
        started = StartedFolder(path, own=own)
        check(path)
        path.mkdir(parents=True, exist_ok=True)
        started.lock(lock_file)
        try:
            yield started
        except BaseException:
            started.leave(failed=True)
            raise
    except OSError as exc:
        if exc.errno in DISK_TROUBLE:
            raise storage_full(path, exc) from exc
        raise RunFolderError(
            f"{path}: cannot be used as {purpose} ({exc.strerror or exc}). Use another --out."
        ) from exc


def _is_of_start(folder: Path) -> bool:
    """Whether there is no file in it, at any depth, or only logs."""
    if folder.name == LOGS_FOLDER and all(
        entry.suffix == ".log" and entry.is_file() for entry in folder.iterdir()
    ):
        return True
    return all(entry.is_dir() and not entry.is_symlink() for entry in folder.rglob("*"))
