"""Waiting for what another process or thread does."""

import time
from collections.abc import Callable
from pathlib import Path

HANGS_AFTER_S = 240.0
"""Far longer than anything here takes on a slow machine: what is not over by then never will be."""


def wait_until(holds: Callable[[], object]) -> None:
    """Returns as soon as `holds()` is true; fails the test after `HANGS_AFTER_S`."""
    deadline = time.monotonic() + HANGS_AFTER_S
    while not holds():
        assert time.monotonic() < deadline, f"not so after {HANGS_AFTER_S:.0f} s"
        time.sleep(0.02)


def is_alive(pid: int) -> bool:
    """Whether the process runs: one that has ended and waits for its parent (a zombie) does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):  # the second: it ended between opening and reading
        return False
    return state != "Z"
