"""Undo the start of a run that ended before its first episode: a mistake leaves no empty folder behind."""

import logging
import os
import shutil
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
        new = [self._path / name for name in sorted(set(os.listdir(self._path)) - self._before)]
        folders = [entry for entry in new if entry.is_dir() and not entry.is_symlink()]
        files = [entry for entry in new if entry not in folders]
        known = self._own.issuperset(file.name for file in files)
        if not known or not all(_is_bare(folder) or _is_of_logs(folder) for folder in folders):
            return
        for file in files:
            file.unlink()
        for folder in folders:
            shutil.rmtree(folder)
        for folder in self._made:  # the innermost first
            if any(folder.iterdir()):  # somebody else has begun to use it
                return
            folder.rmdir()


def _is_of_logs(folder: Path) -> bool:
    return folder.name == LOGS_FOLDER and all(
        entry.suffix == ".log" and entry.is_file() for entry in folder.iterdir()
    )


def _is_bare(folder: Path) -> bool:
    """Whether there is no file in it, at any depth."""
    return all(entry.is_dir() and not entry.is_symlink() for entry in folder.rglob("*"))
