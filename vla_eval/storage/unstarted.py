"""Undo the start of a run that ended before its first episode: a mistake leaves no empty folder behind."""

import logging
import os
from collections.abc import Collection
from pathlib import Path

logger = logging.getLogger(__name__)

LOGS_FOLDER = "logs"


class FolderStart:
    """What a start finds at its place, to be noted before it makes anything there.

    Args:
        path: the folder that is going to be made, if it is not there.
        own: names of what the start writes into it.
    """

    def __init__(self, path: Path, *, own: Collection[str]) -> None:
        self._path = path
        self._own = frozenset(own)
        self._made = [folder for folder in (path, *path.parents) if not folder.exists()]
        self._before = frozenset(os.listdir(path)) if path.is_dir() else frozenset[str]()

    def undo(self) -> None:
        """Remove what the start has made; nothing, if there is anything that it does not know."""
        try:
            self._undo()
        except OSError as exc:  # the error that ended the start says more
            logger.warning("%s: what a failed start has made could not be removed (%s)", self._path, exc)

    def _undo(self) -> None:
        if not self._path.is_dir():
            return
        new = set(os.listdir(self._path)) - self._before
        logs = self._path / LOGS_FOLDER
        if not new <= self._own | {LOGS_FOLDER} or (LOGS_FOLDER in new and not _holds_logs(logs)):
            return
        for name in new - {LOGS_FOLDER}:
            (self._path / name).unlink()
        if LOGS_FOLDER in new:
            for log in logs.iterdir():
                log.unlink()
            logs.rmdir()
        for folder in self._made:  # the innermost first
            if any(folder.iterdir()):  # somebody else has begun to use it
                return
            folder.rmdir()


def _holds_logs(folder: Path) -> bool:
    return all(entry.suffix == ".log" and entry.is_file() for entry in folder.iterdir())
