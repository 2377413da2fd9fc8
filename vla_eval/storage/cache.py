"""Where this package keeps what it can make again: the user's cache folder. Standard library only."""

import functools
import logging
import os
import tempfile
from pathlib import Path

VARIABLE = "XDG_CACHE_HOME"
NO_HOME = "~"  # what stays of it where nobody knows the user: in a container, with a number as user

logger = logging.getLogger(__name__)


def cache_dir() -> Path:
    """Return the user's cache folder of this package (`$XDG_CACHE_HOME` or `~/.cache`)."""
    base = os.environ.get(VARIABLE)
    return (Path(base) if base else Path(os.path.expanduser(NO_HOME)) / ".cache") / "mikasa-vla-eval"


def cached(name: str) -> Path:
    """Return where something of this relative path is, or may be made, in the cache."""
    wanted = cache_dir() / name
    if wanted.exists() or (reason := _why_not(wanted.parent)) is None:
        return wanted
    return Path(_instead_of(cache_dir(), reason).name) / name


def _why_not(folder: Path) -> str | None:
    """Make a folder, or return why it cannot be written."""
    if folder.parts[:1] == (NO_HOME,):
        return "there is no home folder"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as exc:
        return exc.strerror or str(exc)
    return None if os.access(folder, os.W_OK | os.X_OK) else "no permission to write"


@functools.cache  # which keeps it: its folder is removed when Python ends
def _instead_of(folder: Path, reason: str) -> "tempfile.TemporaryDirectory[str]":
    temporary = tempfile.TemporaryDirectory(prefix="mikasa-vla-cache-", ignore_cleanup_errors=True)
    logger.warning(
        "%s: the cache cannot be written (%s). What is made is lost at the end of this process; let %s name "
        "another folder.",
        *(folder, reason, VARIABLE),
    )
    return temporary
