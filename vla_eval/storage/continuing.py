"""Start or continue what has a `run.json`: the file with one more session, unless something has changed.

Knows nothing of what the folder holds beside it.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from vla_eval.storage.run_file import (
    DEVICE,
    Change,
    JsonValue,
    RunDescription,
    RunFile,
    Session,
    environment_changed,
    find_changes,
)

logger = logging.getLogger(__name__)


def continued(
    folder: Path, description: RunDescription, *, shown: Path, allow_environment_change: bool
) -> RunFile:
    """Return what `run.json` must hold from now on; nothing is written.

    Args:
        folder: that of `run.json`, if there is one.
        description: what the run is started with; the device is not compared.
        shown: the folder that messages name.
        allow_environment_change: continue although commit or versions have changed.

    Raises:
        RunChangedError: configuration, recipes or environment are not what they were.
        RunFolderError: the file is damaged.
    """
    session = Session(
        started_at=datetime.now(UTC).isoformat(timespec="seconds"),
        command=description.command,
        options=description.options,
    )
    try:
        known = RunFile.load(folder)
    except FileNotFoundError:
        return RunFile(description=description, sessions=(session,))
    known.check_unchanged(description, shown)
    changes = find_changes(
        without_device(known.description.environment),
        without_device(description.environment),
        prefix="environment",
    )
    check_allowed(changes, shown=shown, allowed=allow_environment_change)
    return known.with_session(replace(session, environment_changes=changes))


def check_allowed(changes: Sequence[Change], *, shown: Path, allowed: bool) -> None:
    """Log the changes, or raise `RunChangedError` if there are any and they are not allowed."""
    if changes and not allowed:
        raise environment_changed(changes, shown)
    for change in changes:
        logger.warning("%s: the environment has changed: %s", shown, change)


def without_device(environment: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    """Return what is known of the environment before a worker has started."""
    return {name: value for name, value in environment.items() if name != DEVICE}
