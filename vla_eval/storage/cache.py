"""Where this package keeps what it can make again: the user's cache folder. Standard library only."""

import os
from pathlib import Path


def cache_dir() -> Path:
    """Return the user's cache folder of this package (`$XDG_CACHE_HOME` or `~/.cache`)."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "mikasa-vla-eval"
