"""Compare what shards of runs or recordings were started with, and describe the whole that they come to."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vla_eval.errors import MergeError, some_of
from vla_eval.storage.continuing import device_changes, known_device, without_device
from vla_eval.storage.run_file import DEVICE, Change, JsonValue, RunFile, Session, find_changes, listed
from vla_eval.storage.shard import Shard


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardPart:
    """A folder that holds a shard, and its `run.json`."""

    path: Path
    run_file: RunFile
    shard: Shard


def as_part(path: Path, run_file: RunFile) -> ShardPart:
    """Return the shard that a folder holds; raise `MergeError` if it was not made with `--shard`."""
    shard = run_file.description.shard
    if shard is None:
        raise MergeError(
            f"{path}: expected a shard (made with --shard I/N), found a whole run. `mikasa-vla report` puts "
            f"whole runs into one table."
        )
    return ShardPart(path=path, run_file=run_file, shard=shard)


def merge_descriptions(parts: Sequence[ShardPart], *, allow_environment_change: bool) -> RunFile:
    """Return what one run's `run.json` would hold, with the sessions of all shards."""
    first, *others = parts
    for other in others:
        _refuse_other_plan(first, other)
    _refuse_doubles(parts)
    sessions: list[Session] = list(first.run_file.sessions)
    device: dict[str, JsonValue] = {}
    for part in parts:
        changes = _environment_changes(first, part)
        if changes and not allow_environment_change:
            raise MergeError(
                f"{part.path}: was made in another environment than {first.path}:\n{listed(changes)}\n"
                f"Run the shard again where the others were made. To merge them all the same, add "
                f"--allow-environment-change: the change is then recorded and the report names it."
            )
        if part is not first:
            sessions += [
                replace(one, environment_changes=(*one.environment_changes, *changes))
                for one in part.run_file.sessions
            ]
        device = {**known_device(part.run_file), **device}
    environment = without_device(first.run_file.description.environment) | (
        {DEVICE: device} if device else {}
    )
    memories = {
        policy: names for part in parts for policy, names in part.run_file.description.memories.items()
    }
    description = replace(first.run_file.description, environment=environment, shard=None, memories=memories)
    return RunFile(description=description, sessions=tuple(sessions))


def missing_shards(parts: Sequence[ShardPart]) -> Iterator[str]:
    """Name the shards of the plan that are not among the parts."""
    count = parts[0].shard.count
    absent = sorted(set(range(1, count + 1)) - {part.shard.number for part in parts})
    if absent:
        numbers = some_of(f"{number}/{count}" for number in absent)
        yield f"{parts[0].run_file.description.name}: no folder of shard {numbers} was named."


def _refuse_other_plan(first: ShardPart, other: ShardPart) -> None:
    one, two = first.run_file.description, other.run_file.description
    changes = [
        *find_changes(one.config, two.config, prefix="config"),
        *find_changes(one.recipes, two.recipes, prefix="recipes"),
        *find_changes(one.servers, two.servers, prefix="servers"),
        *find_changes(_division(first.shard), _division(other.shard), prefix="shard"),
    ]
    if changes:
        raise MergeError(
            f"{other.path}: expected a shard of the same plan as {first.path}, found another:\n"
            f"{listed(changes)}\nMerge the shards of one command, which differ in --shard alone."
        )


def _division(shard: Shard) -> dict[str, JsonValue]:
    return {"count": shard.count, "block_size": shard.block_size, "groups": shard.groups}


def _refuse_doubles(parts: Sequence[ShardPart]) -> None:
    path_of: dict[int, Path] = {}
    for part in parts:
        if part.shard.number in path_of:
            raise MergeError(
                f"shard {part.shard} is named twice: {path_of[part.shard.number]} and {part.path} have the "
                f"same episodes. Name one of them."
            )
        path_of[part.shard.number] = part.path


def _environment_changes(first: ShardPart, other: ShardPart) -> tuple[Change, ...]:
    """Return how the environments differ; of the devices, in what both state."""
    environments = [without_device(part.run_file.description.environment) for part in (first, other)]
    return (
        *find_changes(*environments, prefix="environment"),
        *device_changes(first.run_file, known_device(other.run_file)),
    )
