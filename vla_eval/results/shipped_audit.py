"""The shortcut audits that ship, of this package's tasks and of the official ones, each made by a command.

    mikasa-vla audit --format json > vla_eval/results/shipped_audit.json
    mikasa-vla audit --suite objects --format json > vla_eval/results/objects_audit.json
    mikasa-vla audit --suite mikasa_vla_90 --format json > vla_eval/results/official_audit.json
    mikasa-vla audit --stored-frames --format json > vla_eval/results/stored_frames.json

Imports neither statistics nor simulators, so that a report can quote it.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple  # Any: arguments of tasks

from vla_eval.errors import ReportError
from vla_eval.strict.json_text import Count, Positive, Rate, Source, as_dataclass, loads, read_file, shorten

AuditProtocol = Literal["paper", "strict", "official"]
STRICT: Mapping[str, bool] = {"freeze_until_choice": True, "strict_choice": True, "phase_gate_success": True}


class Rules(NamedTuple):
    """A set of rules: the arguments of the tasks, its words in a note, and the page with its audit."""

    arguments: Mapping[str, bool]
    words: str
    page: str


PROTOCOLS: Mapping[AuditProtocol, Rules] = {
    "paper": Rules({}, "the paper's rule", "docs/audit.md"),
    "strict": Rules(STRICT, "the strict rule", "docs/audit.md"),
    "official": Rules({}, "the official rule", "docs/audit_official.md"),
}
"""The official package's tasks have one set, their own."""

SHORTCUTS: Mapping[str, tuple[str, str]] = {
    "hold": ("won without acting", "without acting"),
    "random": ("won by chance motions", "by chance motions"),
    "tour": ("can be toured", "by touching one candidate after another"),
    "body_memory": ("body can store the cue", "by storing the cue in the gripper"),
    "cue_touch": ("won by staying at the cue", "by staying where the cue was shown"),
    "cue_blind": ("won without the cue", "without the cue"),
    "one_frame": ("won from single frames", "from single frames"),
}
"""Control that needs no memory -> the verdict if it finds a shortcut, and how the task is won by it."""
ROADS: Mapping[str, str] = dict(SHORTCUTS.values())

NEEDS_MEMORY = "needs memory"
UNDECIDED = "not decided"
NOT_AUDITED = "not audited: no scripted control"
OTHER_VERDICTS: Mapping[str, str] = {
    NEEDS_MEMORY: "no shortcut found",
    UNDECIDED: "not decided by so few episodes",
    NOT_AUDITED: "not audited, for lack of a scripted control",
}
"""A verdict without a shortcut -> its words in a note."""

ONE, SEVERAL = "one stored frame is enough", "several stored frames"
NEWEST = "the newest frame is enough"
INTEGRATED = "must be integrated over time"
UNREAD = "not read by linear probes"
STORED: Mapping[str, str] = {
    NEWEST: "the newest frame is enough, so that nothing has to be remembered, in",
    ONE: "one stored frame is enough to remember the cue of",
    SEVERAL: "it takes several stored frames to remember the cue of",
    INTEGRATED: "no stored frame is enough, what moves has to be tracked over time in",
}
"""A verdict about what has to be stored -> its words in a note, before the tasks."""
Asked = Literal["item", "place", "set", "order"]
"""Of `StoredFrames`: the item; its place at the end, among alike ones; the set of items; the items in the
order shown."""

FILE = Path(__file__).with_suffix(".json")
OBJECTS_FILE = FILE.with_name("objects_audit.json")
OFFICIAL_FILE = FILE.with_name("official_audit.json")
STORED_FRAMES_FILE = FILE.with_name("stored_frames.json")
OFFICIAL_ARGUMENTS = {"mug", "bulb"}  # that change nothing of what is audited


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """The counts of one control on one task."""

    n_episodes: Count
    # `success_once`, `success_at_end`: in how many of them the success rule held at any step, at the
    # last; None if episodes ended at their first success
    success_once: Count
    success_at_end: Count | None
    # in how many the first candidate touched was right; None without candidates
    first_choice: Count | None
    chance: Rate | None  # mean `chance_success` of the episodes; None if it has to be measured


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskAudit:
    """The counts of all controls on one task under one protocol, and the verdict, with the shortcuts."""

    task: str
    version: Positive
    protocol: AuditProtocol
    chance: Rate | None
    counts: dict[str, Counts]
    verdict: tuple[str, ...]
    n_errors: Count

    @property
    def n_episodes(self) -> int:
        """How many episodes each control has, at least; 0 if none was run."""
        return min((one.n_episodes for one in self.counts.values()), default=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredFrames:
    """How much of one task has to be stored; the counts are episodes in which linear probes are right."""

    task: str
    version: Positive
    asked: Asked
    n_episodes: Positive
    chance: Rate  # of the most frequent answer
    newest: Count  # from the newest frame alone, the first of the response
    first: Count  # from the first frame and the newest
    cue_end: Count  # from the last frame of the cue and the newest
    best: Count  # from the newest and the best other one, which the other folds choose
    # the one that most folds choose; None: the first frame or the cue's last, at another step in each episode
    best_step: Count | None
    all: Count  # from all frames
    n_frames: Count | None  # the fewest that show it, in the episode that takes most; None if not known
    probes: str  # the verdict of the probes alone
    verdict: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shipped:
    """So that a message says `audits.0.task`."""

    audits: tuple[TaskAudit, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _ShippedFrames:
    """So that a message says `audits.0.task`."""

    audits: tuple[StoredFrames, ...]


@functools.cache
def shipped_audits() -> Mapping[tuple[str, AuditProtocol], TaskAudit]:
    """Return (task, protocol) -> the shipped audit of it, or raise `ReportError` if a file is damaged."""
    audits = [one for file in (FILE, OBJECTS_FILE, OFFICIAL_FILE) for one in _read(file, _Shipped).audits]
    return {(one.task, one.protocol): one for one in audits}


@functools.cache
def stored_frames() -> Mapping[str, StoredFrames]:
    """Return task -> how much of it has to be stored, or raise `ReportError` if the file is damaged.

    Where several things are asked of a task, the last one: the set before the order, which decides the same.
    """
    return {one.task: one for one in _read(STORED_FRAMES_FILE, _ShippedFrames).audits}


def _read[T](file: Path, kind: type[T]) -> T:
    source = Source(
        where=str(file),
        what="the shipped audit",
        remedy="The file was changed by another program; install mikasa-vla-eval again.",
        error=ReportError,
    )
    try:
        rows = loads(read_file(file, source))
    except ValueError as exc:
        raise source.refuse("something else", shorten(str(exc))) from exc
    return as_dataclass(kind, {"audits": rows}, source)


def protocol_of(env: Mapping[str, Any], *, is_official: bool = False) -> AuditProtocol | None:
    """Return the rules that the arguments of a task select; None if they were not audited."""
    if is_official:
        return "official" if set(env) <= OFFICIAL_ARGUMENTS else None
    if not env:
        return "paper"
    # Success is gated by phase by default, so omitting the argument is strict, too.
    return "strict" if {"phase_gate_success": True, **env} == STRICT else None
