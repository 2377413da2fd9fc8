"""`run.json`: what a run was started with, each time it was started, and whether that has changed."""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from vla_eval.errors import RunFolderError
from vla_eval.plain_text import printable
from vla_eval.seeding import SeedRange
from vla_eval.storage.durable import replace_file
from vla_eval.storage.planned import PlannedEpisodes, planned_config
from vla_eval.storage.shard import Shard
from vla_eval.strict.json_text import Source, as_dataclass, read_file, read_json, read_version

FORMAT_VERSION = 1
"""Of the whole run folder. Raise it when a file changes its meaning; others are refused."""

RUN_FILE = "run.json"
NOT_SET = "(not set)"
MAX_LISTED, MAX_LINE = 20, 400  # changes in one message, and characters of each
SPARSE_FIELDS = ("shard", "training_seeds", "memories")  # of a description; written where they say something
DEVICE = "device"  # the part of the environment that is known only once a worker has started

type JsonValue = bool | int | float | str | Sequence[JsonValue] | Mapping[str, JsonValue] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunDescription:
    """What makes a run this run: compared on resume, but for options, command and what weights imply."""

    name: str
    config: Mapping[str, JsonValue]  # the resolved configuration, as far as results depend on it
    recipes: Mapping[str, str]  # recipe as shown -> sha256
    environment: Mapping[str, JsonValue]  # commit, versions, device; a change may be allowed
    options: Mapping[str, JsonValue]  # workers, timeouts and the like
    command: str  # what the user typed
    # learned policy -> by which statistics it normalises; not compared
    normalization: Mapping[str, JsonValue] = field(default_factory=dict)
    # policy behind a socket -> its server's description
    servers: Mapping[str, JsonValue] = field(default_factory=dict)
    shard: Shard | None = None  # which part of the plan it is; None: all of it
    # seeds of the demonstrations that policies were trained on, where known; not compared
    training_seeds: Mapping[str, Mapping[str, tuple[SeedRange, ...]]] = field(default_factory=dict)
    # policy -> the parts of its memory, of the world as drawn of a probe; not compared
    memories: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


class Change(NamedTuple):
    """One value that is not what it was; `old` and `new` are JSON, or `(not set)`."""

    path: str
    old: str
    new: str

    def __str__(self) -> str:
        """Return `config.episodes: 50 -> 100`."""
        return f"{self.path}: {self.old} -> {self.new}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """One time that the run was started or continued."""

    started_at: str  # ISO 8601, UTC
    command: str
    options: Mapping[str, JsonValue]
    # how the environment differed from the one the run was started in
    environment_changes: tuple[Change, ...] = ()
    # by what the run grew: more episodes, runs, policies, tasks or n_action_steps
    plan_changes: tuple[Change, ...] = ()
    # lines on instructions that a policy's tokenizer cut, or took for that of another task
    sentences: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFile:
    """The content of `run.json`; the last session is the current one."""

    description: RunDescription
    sessions: tuple[Session, ...]

    def save(self, folder: Path) -> None:
        """Write `run.json`; after a `StorageFullError` the old one is still there."""
        data = {
            "format_version": FORMAT_VERSION,
            **_description(self.description),
            "sessions": [_session_fields(session) for session in self.sessions],
        }
        text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False, default=_plain)
        replace_file(folder / RUN_FILE, f"{text}\n")

    @classmethod
    def load(cls, folder: Path) -> "RunFile":
        """Read `run.json`; `FileNotFoundError` if there is none, `RunFolderError` if it is damaged."""
        source = _source(folder)
        data = read_json(read_file(folder / RUN_FILE, source), source)
        read_version(data, "format_version", FORMAT_VERSION, source)
        sessions = as_dataclass(_Sessions, {"sessions": data.pop("sessions", None)}, source).sessions
        if not sessions:
            raise source.refuse("no sessions", "expected at least one")
        return cls(description=as_dataclass(RunDescription, data, source), sessions=sessions)

    def planned(
        self, folder: Path, groups: Collection[tuple[str, str, int]] | None = None
    ) -> PlannedEpisodes:
        """Return which episodes the run has; `groups` are known from the plan, or from the shard."""
        config, shard = planned_config(self.description.config, _source(folder)), self.description.shard
        known = groups if shard is None else shard.groups
        return PlannedEpisodes(config=config, groups=known, shard=shard)

    def with_device(self, device: Mapping[str, JsonValue], changes: Sequence[Change]) -> "RunFile":
        """Return this with more known of the device, and with changes noted in the current session."""
        environment = {**self.description.environment, DEVICE: device}
        description = replace(self.description, environment=environment)
        return replace(self, description=description).with_changes(changes)

    def with_memory(self, policy: str, parts: tuple[str, ...]) -> "RunFile":
        """Return this with the parts of a policy's memory; none for a policy without one."""
        memories = {**self.description.memories, policy: parts}
        return replace(self, description=replace(self.description, memories=memories))

    def with_changes(self, changes: Sequence[Change]) -> "RunFile":
        """Return this with changes noted in the current session."""
        *earlier, current = self.sessions
        noted = (*current.environment_changes, *(c for c in changes if c not in current.environment_changes))
        return replace(self, sessions=(*earlier, replace(current, environment_changes=noted)))

    def with_sentence(self, line: str) -> "RunFile":
        """Return this with a line on an instruction noted in the current session."""
        *earlier, current = self.sessions
        return replace(self, sessions=(*earlier, replace(current, sentences=(*current.sentences, line))))


def find_changes(
    old: Mapping[str, JsonValue], new: Mapping[str, JsonValue], *, prefix: str
) -> tuple[Change, ...]:
    """Compare two nested mappings value by value, lists as wholes; paths begin with the prefix."""
    old_texts, new_texts = dict(leaves(old, prefix=prefix)), dict(leaves(new, prefix=prefix))
    return tuple(
        Change(path, old_texts.get(path, NOT_SET), new_texts.get(path, NOT_SET))
        for path in dict.fromkeys((*old_texts, *new_texts))
        if old_texts.get(path) != new_texts.get(path)
    )


def leaves(value: JsonValue, *, prefix: str) -> Iterator[tuple[str, str]]:
    """Yield path and JSON text of each value that is not a mapping; an empty mapping has none."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from leaves(item, prefix=f"{prefix}.{key}" if prefix else str(key))
    else:
        # Through JSON, so that a tuple equals the list that it becomes in the file.
        yield prefix, json.dumps(value, ensure_ascii=False, sort_keys=True, default=_plain)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sessions:
    """As they are in the file, next to the description."""

    sessions: tuple[Session, ...]


def _source(folder: Path) -> Source:
    return Source(
        where=str(folder / RUN_FILE),
        what="the description of a run",
        remedy="The file was changed by another program; restore it or start a new run folder.",
        error=RunFolderError,
    )


def _fields(value: RunDescription | Session) -> dict[str, Any]:  # Any: JSON
    return {one.name: getattr(value, one.name) for one in fields(value)}


def _session_fields(session: Session) -> dict[str, Any]:  # Any: JSON
    data = _fields(session)
    for name in ("environment_changes", "plan_changes"):
        data[name] = [change._asdict() for change in data[name]]
    for name in ("plan_changes", "sentences"):
        if not data[name]:
            del data[name]  # so that earlier versions read a run without them
    return data


def _description(value: RunDescription) -> dict[str, Any]:  # Any: JSON
    # Fields that say nothing are left out, so that earlier versions of this program read the file.
    own = {name: item for name, item in _fields(value).items() if name not in SPARSE_FIELDS}
    if value.memories:
        own["memories"] = value.memories
    if value.shard is not None:
        own["shard"] = asdict(value.shard)
    if value.training_seeds:
        own["training_seeds"] = {
            policy: {task: [asdict(one) for one in seeds] for task, seeds in tasks.items()}
            for policy, tasks in value.training_seeds.items()
        }
    return own


def _plain(value: object) -> dict[str, JsonValue]:
    """Make a dict of a mapping that json does not know as one."""
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{value!r:.80} is {type(value).__name__}, which JSON cannot hold")


def listed(changes: Sequence[Change]) -> str:
    """Return one line per change, whatever the values are."""
    lines = [printable(str(change)) for change in changes[:MAX_LISTED]]
    shown = [line if len(line) <= MAX_LINE else f"{line[:MAX_LINE]}…" for line in lines]
    more = [f"… and {len(changes) - MAX_LISTED} more"] if len(changes) > MAX_LISTED else []
    return "\n".join(f"  {line}" for line in (*shown, *more))
