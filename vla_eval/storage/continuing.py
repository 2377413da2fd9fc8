"""Start or continue what has a `run.json`, unless something has changed; a run may grow."""

import itertools
import logging
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from vla_eval.errors import RunChangedError
from vla_eval.storage.run_file import (
    DEVICE,
    Change,
    JsonValue,
    RunDescription,
    RunFile,
    Session,
    find_changes,
    listed,
)

logger = logging.getLogger(__name__)

GROWING = ("tasks", "task_versions", "policies", "policy_names", "n_action_steps", "episodes", "runs")
"""Fields of a configuration of which more is a plan with more episodes."""
OUT_FLAG = "--out"


def continued(
    folder: Path,
    description: RunDescription,
    *,
    shown: Path,
    allow_environment_change: bool,
    may_grow: bool = False,
) -> RunFile:
    """Return what `run.json` must hold from now on; nothing is written. Raises `RunChangedError`.

    `folder` is that of `run.json`, `shown` the one that messages name. The device of the description is not
    compared; with `may_grow`, more of what is planned, the rest being the same, is not a change.
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
        known.planned(folder)  # what is not a configuration cannot be compared with a larger one
    _check_unchanged(old, description, shown, may_grow=may_grow)
    changes = find_changes(
        without_device(old.environment), without_device(description.environment), prefix="environment"
    )
    check_allowed(changes, shown=shown, allowed=allow_environment_change)
    growth = find_changes(old.config, description.config, prefix="config")
    for change in growth:
        logger.info("%s: the run grows: %s", shown, change)
    if growth:  # the command that makes the whole run is the newest
        known = replace(
            known, description=replace(description, environment=old.environment, memories=old.memories)
        )
    session = replace(session, environment_changes=changes, plan_changes=growth)
    return replace(known, sessions=(*known.sessions, session))


def _check_unchanged(old: RunDescription, new: RunDescription, shown: Path, *, may_grow: bool) -> None:
    """Raise `RunChangedError` if the configuration, a recipe or a policy server is not what it was."""
    if changes := find_changes(_shard(old), _shard(new), prefix="shard"):
        raise _changed(
            "configuration", changes, shown, "Each shard needs a folder of its own: use another --out."
        )
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
        raise _changed("configuration", changes, shown, remedy)
    if changes := find_changes(old.servers, compared.servers, prefix="servers"):
        remedy = "Start the former policy there again to continue this run, or use another --out."
        raise _changed("policy at the server", changes, shown, remedy)


def _changed(what: str, changes: Sequence[Change], where: Path, remedy: str) -> RunChangedError:
    return RunChangedError(f"{where}: this run was started with another {what}:\n{listed(changes)}\n{remedy}")


def check_allowed(changes: Sequence[Change], *, shown: Path, allowed: bool) -> None:
    """Log the changes, or raise `RunChangedError` if there are any and they are not allowed."""
    if changes and not allowed:
        raise RunChangedError(
            f"{shown}: this run was started in another environment:\n{listed(changes)}\n"
            f"Use another --out, or restore the old environment. To continue all the same, add "
            f"--allow-environment-change: the change is then recorded and the report names it."
        )
    for change in changes:
        logger.warning("%s: the environment has changed: %s", shown, change)


def without_device(environment: Mapping[str, JsonValue]) -> dict[str, JsonValue]:
    """Return the environment as it is known before a worker has started."""
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


def without_growth(new: RunDescription, old: RunDescription) -> RunDescription:
    """Return `new` without what it only adds to `old`: what still differs changes what was run."""
    config = {
        name: old.config[name] if name in GROWING and _covers(value, old.config.get(name)) else value
        for name, value in new.config.items()
    }
    return replace(
        new,
        config=config,
        recipes={name: digest for name, digest in new.recipes.items() if name in old.recipes},
        servers={name: server for name, server in new.servers.items() if name in old.servers},
    )


def _covers(new: JsonValue, old: JsonValue) -> bool:
    """Whether a plan with the new value has all episodes of one with the old value."""
    match new, old:
        case int(), int():
            return new >= old
        case Mapping(), Mapping():
            return all(new.get(key) == value for key, value in old.items())
        case (str(), _) | (_, str()):
            return False
        case Sequence(), Sequence():
            return all(any(_continues(one, item) for one in new) for item in old)
    return False


def _continues(new: JsonValue, old: JsonValue) -> bool:
    """Whether an item is the same, or a policy of several checkpoints, `NAME=A,B`, with further ones."""
    is_longer = isinstance(new, str) and isinstance(old, str) and "=" in old and new.startswith(f"{old},")
    return new == old or is_longer


def command_beside(command: str, out: Path) -> str:
    """Return the command that the user typed, with a free folder next to `out`."""
    words = shlex.split(command)
    beside = (out.with_name(f"{out.name}-{n}") for n in itertools.count(2))
    free = next(path for path in beside if not path.exists())
    kept: list[str] = []
    skips = False
    for word in words:
        if not skips and word != OUT_FLAG and not word.startswith(f"{OUT_FLAG}="):
            kept.append(word)
        skips = word == OUT_FLAG
    return shlex.join([*kept, OUT_FLAG, str(free)])
