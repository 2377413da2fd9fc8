"""Switch the lock on, and let through what the user or this program's own code needs."""

import contextlib
import importlib.abc
import importlib.machinery
import logging
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any  # finders and specs of modules

from vla_eval.errors import LockedImportError
from vla_eval.lock.events import TOOLS, audit, refused
from vla_eval.lock.state import STATE, code_folders, library_folders, may_run

OFF_VARIABLE = "MIKASA_VLA_NO_LOCK"
"""Environment variable that `--no-lock` sets: this process and those that it starts are not locked."""
WRITING_VARIABLE = "MIKASA_VLA_WRITES"
"""Environment variable: the folders that a worker may write to, those of its parent."""
HUB_VARIABLE, ONLINE = "HF_HUB_OFFLINE", ("0", "false", "no", "off")

logger = logging.getLogger(__name__)


@contextlib.contextmanager
def locked() -> Iterator[None]:
    """Lock this process while the context is open, unless `--no-lock` was given."""
    if STATE.is_on or os.environ.get(OFF_VARIABLE):
        yield
        return
    before = STATE.network, STATE.everything, set(STATE.writes), set(STATE.foreign), set(STATE.hosts)
    STATE.network = STATE.everything = None
    lock()
    try:
        yield
    finally:
        STATE.is_on = False
        STATE.network, STATE.everything, STATE.writes, STATE.foreign, STATE.hosts = before
        if STATE.finder in sys.meta_path:
            sys.meta_path.remove(STATE.finder)


def lock() -> None:
    """Lock this process for good, unless `--no-lock` was given: what can be imported now may be run."""
    if STATE.is_on or os.environ.get(OFF_VARIABLE):
        return
    STATE.code = code_folders()
    STATE.tools = frozenset(filter(None, map(shutil.which, TOOLS)))
    STATE.writes |= library_folders() | _inherited()
    STATE.finder = _InstalledOnly(tuple(sys.meta_path))
    sys.meta_path.insert(0, STATE.finder)
    STATE.is_on = True
    if os.environ.get(HUB_VARIABLE, "1").lower() in ONLINE:
        let_connect(f"{HUB_VARIABLE}=0")
    if not STATE.has_hook:
        sys.addaudithook(audit)
        STATE.has_hook = True


def let_write(*paths: Path) -> None:
    """Let this process, and the workers that it starts, write to what the user has named."""
    STATE.writes.update(os.path.realpath(path) for path in paths)


def distrust(folder: Path) -> None:
    """Run no Python file of a folder that is about to be read, even if it lies where packages do."""
    STATE.foreign.add(os.path.realpath(folder))


def let_resolve(host: str) -> None:
    """Let this process look up a name: of the address that it listens at."""
    STATE.hosts.add(host)


def let_connect(why: str, *programs: str) -> None:
    """Let this process connect to anything, and start these programs, since the user asked for it (`why`)."""
    if not STATE.is_on:
        return
    STATE.network = STATE.network or why
    STATE.tools |= frozenset(filter(None, map(shutil.which, programs)))


@contextlib.contextmanager
def connecting(why: str) -> Iterator[None]:
    """Let this process connect to anything while the context is open."""
    before = STATE.network
    let_connect(why)
    try:
        yield
    finally:
        STATE.network = before


def let_everything(why: str) -> None:
    """Let this process start programs, connect, write and import: it runs code of the user's own."""
    if STATE.is_on and STATE.everything is None:
        logger.info("nothing is locked in this process: %s", why)
        STATE.everything = why


@contextlib.contextmanager
def own_need() -> Iterator[None]:
    """Let this thread do anything while the context is open: what the caller's own code says."""
    STATE.ours.depth = getattr(STATE.ours, "depth", 0) + 1
    try:
        yield
    finally:
        STATE.ours.depth -= 1


def folders_for_workers() -> str:
    """Return the value of `WRITING_VARIABLE` for a worker that this process starts."""
    return os.pathsep.join(sorted(STATE.writes | _inherited()))


def _inherited() -> set[str]:
    return set(filter(None, os.environ.get(WRITING_VARIABLE, "").split(os.pathsep)))


class _InstalledOnly(importlib.abc.MetaPathFinder):
    """Finds what the others find, and refuses what lies where nothing could be imported at the start."""

    def __init__(self, finders: Sequence[Any]) -> None:
        """Trust the finders of the start, but for the one that searches `sys.path`, which may have grown."""
        self._trusted = [finder for finder in finders if finder is not importlib.machinery.PathFinder]

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: Any = None) -> Any:
        for finder in tuple(sys.meta_path):
            spec = None if finder is self else finder.find_spec(fullname, path, target)
            if spec is None:
                continue
            places: list[str | None]
            places = [spec.origin] if spec.has_location else list(spec.submodule_search_locations or ())
            are_installed = all(place is not None and may_run(place) for place in places)
            if STATE.refuses and finder not in self._trusted and not are_installed:
                raise LockedImportError(str(refused(f"import the module '{fullname}' from {places[0]}")))
            return spec
        return None
