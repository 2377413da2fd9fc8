"""`run.json`: what a run was started with, each time it was started, and whether that has changed.

Knows nothing of episodes; the values it keeps are plain JSON and mean nothing to it.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from vla_eval.errors import RunChangedError, RunFolderError
from vla_eval.storage.durable import replace_file

FORMAT_VERSION = 1
"""Of the whole run folder. Raise it when a file changes its meaning; others are refused."""

RUN_FILE = "run.json"
NOT_SET = "(not set)"
DEVICE = "device"  # the part of the environment that is known only once a worker has started

type JsonValue = bool | int | float | str | Sequence[JsonValue] | Mapping[str, JsonValue] | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RunDescription:
    """What makes a run this run.

    Attributes:
        name: the configuration's name.
        config: the resolved configuration, as far as results depend on it; compared on resume.
        recipes: recipe as shown -> sha256; compared on resume.
        environment: commit, versions, device; compared on resume unless a change is allowed.
        options: workers, timeouts and the like; recorded, never compared.
        command: what the user typed.
        normalization: learned policy -> by which statistics it normalises; recorded only, since the digest
            of the weights in `recipes` covers them.
    """

    name: str
    config: Mapping[str, JsonValue]
    recipes: Mapping[str, str]
    environment: Mapping[str, JsonValue]
    options: Mapping[str, JsonValue]
    command: str
    normalization: Mapping[str, JsonValue] = field(default_factory=dict)


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
    """One time that the run was started or continued.

    Attributes:
        started_at: ISO 8601, UTC.
        command: what the user typed.
        options: see `RunDescription`.
        environment_changes: how the environment differed from the one the run was started in.
    """

    started_at: str
    command: str
    options: Mapping[str, JsonValue]
    environment_changes: tuple[Change, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFile:
    """The content of `run.json`; the last session is the current one."""

    description: RunDescription
    sessions: tuple[Session, ...]

    def save(self, folder: Path) -> None:
        """Write `run.json`.

        Raises:
            StorageFullError: it could not be written; the old one is still there.
        """
        data = {
            "format_version": FORMAT_VERSION,
            **_fields(self.description),
            "sessions": [
                {
                    **_fields(session),
                    "environment_changes": [c._asdict() for c in session.environment_changes],
                }
                for session in self.sessions
            ],
        }
        text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False, default=_plain)
        replace_file(folder / RUN_FILE, f"{text}\n")

    @classmethod
    def load(cls, folder: Path) -> "RunFile":
        """Read `run.json`.

        Raises:
            RunFolderError: it is damaged, or of another version.
            FileNotFoundError: there is none.
        """
        path = folder / RUN_FILE
        try:
            data: dict[str, Any] = json.loads(path.read_bytes())  # Any: JSON
            version = data.pop("format_version")
            if version == FORMAT_VERSION:
                sessions = tuple(_session(item) for item in data.pop("sessions"))
                return cls(description=RunDescription(**data), sessions=sessions)
        except (ValueError, KeyError, TypeError, AttributeError) as exc:
            raise RunFolderError(
                f"{path}: expected the description of a run, found something else ({exc!r:.120}). The file "
                f"was changed by another program; restore it or start a new run folder."
            ) from exc
        raise RunFolderError(
            f"{path}: format version {version}, this program reads version {FORMAT_VERSION}. Use the version "
            f"of mikasa-vla-eval that wrote it, or another --out."
        )

    def check_unchanged(self, new: RunDescription, where: Path) -> None:
        """Raise `RunChangedError` if the configuration or a recipe is not what it was."""
        old = self.description
        changes = (
            *find_changes(old.config, new.config, prefix="config"),
            *find_changes(old.recipes, new.recipes, prefix="recipes"),
        )
        if changes:
            raise RunChangedError(
                f"{where}: this run was started with another configuration:\n{_listed(changes)}\n"
                f"Use another --out for the new configuration, or restore the old one to continue this run."
            )

    def with_session(self, session: Session) -> "RunFile":
        """Return this with one more session."""
        return replace(self, sessions=(*self.sessions, session))

    def with_device(self, device: Mapping[str, JsonValue], changes: Sequence[Change]) -> "RunFile":
        """Return this with more known of the device, and with changes noted in the current session."""
        environment = {**self.description.environment, DEVICE: device}
        *earlier, current = self.sessions
        noted = (*current.environment_changes, *(c for c in changes if c not in current.environment_changes))
        return RunFile(
            description=replace(self.description, environment=environment),
            sessions=(*earlier, replace(current, environment_changes=noted)),
        )


def environment_changed(changes: Sequence[Change], where: Path) -> RunChangedError:
    """Build the error for a run that is continued on another machine or with other versions."""
    return RunChangedError(
        f"{where}: this run was started in another environment:\n{_listed(changes)}\n"
        f"Use another --out, or restore the old environment. To continue all the same, add "
        f"--allow-environment-change: the change is then recorded and the report names it."
    )


def find_changes(
    old: Mapping[str, JsonValue], new: Mapping[str, JsonValue], *, prefix: str
) -> tuple[Change, ...]:
    """Compare two nested mappings value by value.

    Args:
        old: what was recorded.
        new: what there is now.
        prefix: what the paths begin with.

    Returns:
        One change per path whose value differs. Lists are compared as wholes.
    """
    old_texts, new_texts = dict(leaves(old, prefix=prefix)), dict(leaves(new, prefix=prefix))
    return tuple(
        Change(path, old_texts.get(path, NOT_SET), new_texts.get(path, NOT_SET))
        for path in dict.fromkeys((*old_texts, *new_texts))
        if old_texts.get(path) != new_texts.get(path)
    )


def leaves(value: JsonValue, *, prefix: str) -> Iterator[tuple[str, str]]:
    """Yield path and JSON text of each value that is no mapping; an empty mapping has none."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from leaves(item, prefix=f"{prefix}.{key}" if prefix else str(key))
    else:
        # Through JSON, so that a tuple equals the list that it becomes in the file.
        yield prefix, json.dumps(value, ensure_ascii=False, sort_keys=True, default=_plain)


def _session(data: dict[str, Any]) -> Session:  # Any: JSON
    changes = tuple(Change(**change) for change in data.pop("environment_changes"))
    return Session(**data, environment_changes=changes)


def _fields(value: RunDescription | Session) -> dict[str, Any]:  # Any: JSON
    return {one.name: getattr(value, one.name) for one in fields(value)}


def _plain(value: object) -> dict[str, JsonValue]:
    """Make a dict of a mapping that json does not know as one."""
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{value!r:.80} is {type(value).__name__}, which JSON cannot hold")


def _listed(changes: Sequence[Change]) -> str:
    return "\n".join(f"  {change}" for change in changes)
