"""Start or continue what has a `run.json`: the file with one more session, unless something has changed.

Knows nothing of what the folder holds beside it.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from vla_eval.storage.plan_growth import command_beside, without_growth
from vla_eval.storage.run_file import (
    DEVICE,
    Change,
    JsonValue,
    RunDescription,
    RunFile,
    Session,
    environment_changed,
    find_changes,
    run_changed,
    server_changed,
)

logger = logging.getLogger(__name__)


def continued(
    folder: Path,
    description: RunDescription,
    *,
    shown: Path,
    allow_environment_change: bool,
    may_grow: bool = False,
) -> RunFile:
    """Return what `run.json` must hold from now on; nothing is written.

    Args:
        folder: that of `run.json`, if there is one.
        description: what the run is started with; the device is not compared.
        shown: the folder that messages name.
        allow_environment_change: continue although commit or versions have changed.
        may_grow: more of what is planned, the rest being the same, is no change.

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
    old = known.description
    if may_grow:
        known.planned(folder)  # what is no configuration cannot be compared with a larger one
    _check_unchanged(old, description, shown, may_grow=may_grow)
    changes = find_changes(
        without_device(old.environment), without_device(description.environment), prefix="environment"
    )
    check_allowed(changes, shown=shown, allowed=allow_environment_change)
    growth = find_changes(old.config, description.config, prefix="config")
    for change in growth:
        logger.info("%s: the run grows: %s", shown, change)
    if growth:  # the command that makes the whole run is the newest
        known = replace(known, description=replace(description, environment=old.environment))
    return known.with_session(replace(session, environment_changes=changes, plan_changes=growth))


def _check_unchanged(old: RunDescription, new: RunDescription, shown: Path, *, may_grow: bool) -> None:
    """Raise `RunChangedError` if the configuration, a recipe or a policy server is not what it was."""
    if changes := find_changes(_shard(old), _shard(new), prefix="shard"):
        raise run_changed(changes, shown, remedy="Each shard needs a folder of its own: use another --out.")
    compared = without_growth(new, old) if may_grow else new
    changes = (
        *find_changes(old.config, compared.config, prefix="config"),
        *find_changes(old.recipes, compared.recipes, prefix="recipes"),
    )
    if changes:
        remedy = "Use another --out for the new configuration, or restore the old one to continue this run."
        if may_grow and new.command:
            remedy = (
                "To add episodes, runs, policies, tasks or n_action_steps, name all that the run has and the "
                "new ones. Anything else goes into a folder beside it, and `report` takes both:\n"
                f"  {command_beside(new.command, shown)}"
            )
        raise run_changed(changes, shown, remedy=remedy)
    if changes := find_changes(old.servers, compared.servers, prefix="servers"):
        raise server_changed(changes, shown)


def check_allowed(changes: Sequence[Change], *, shown: Path, allowed: bool) -> None:
    """Log the changes, or raise `RunChangedError` if there are any and they are not allowed."""
    if changes and not allowed:
        raise environment_changed(changes, shown)
    for change in changes:
        logger.warning("%s: the environment has changed: %s", shown, change)


def without_device(environment: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    """Return what is known of the environment before a worker has started."""
    return {name: value for name, value in environment.items() if name != DEVICE}


def known_device(run_file: RunFile) -> dict[str, JsonValue]:
    """Return what is recorded of the device; nothing before a worker has started."""
    device = run_file.description.environment.get(DEVICE)
    return dict(device) if isinstance(device, Mapping) else {}


def device_changes(run_file: RunFile, device: Mapping[str, JsonValue]) -> tuple[Change, ...]:
    """Compare facts about a device with those that are recorded; a session may know fewer or more."""
    recorded = known_device(run_file)
    both = [name for name in device if name in recorded]
    before, now = ({name: facts[name] for name in both} for facts in (recorded, device))
    return find_changes(before, now, prefix=f"environment.{DEVICE}")


def _shard(description: RunDescription) -> dict[str, JsonValue]:
    """Return which shard a run is; its groups follow from the configuration, which may grow."""
    shard = description.shard
    return {} if shard is None else {"number": shard.number, "count": shard.count}
