"""The shortcut audits that ship, of this package's tasks and of the official ones, each made by a command.

    mikasa-vla audit --format json > vla_eval/results/shipped_audit.json
    mikasa-vla audit --suite mikasa_vla_90 --format json > vla_eval/results/official_audit.json

Imports neither statistics nor simulators, so that a report can quote it.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from vla_eval.errors import ReportError
from vla_eval.strict.json_text import Count, Positive, Rate, Source, as_dataclass, loads, read_file, shorten

AuditProtocol = Literal["paper", "strict", "official"]
STRICT: Mapping[str, bool] = {
    "freeze_until_choice": True,
    "strict_choice": True,
    "phase_gate_success": True,
}
PROTOCOLS: Mapping[AuditProtocol, Mapping[str, bool]] = {"paper": {}, "strict": STRICT, "official": {}}
"""Name of a set of rules -> arguments of the tasks. The official package's tasks have one set, their own."""

FILE = Path(__file__).with_suffix(".json")
OFFICIAL_FILE = FILE.with_name("official_audit.json")
OFFICIAL_ARGUMENTS = {"mug"}  # that change nothing of what is audited


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """The counts of one control on one task.

    Attributes:
        n_episodes: episodes with a result; an error is not a result.
        success_once, success_at_end: in how many of them the success rule held at any step, at the last; None
            if episodes ended at their first success.
        first_choice: in how many the first candidate touched was right; None without candidates.
        chance: mean `chance_success` of the episodes; None if it has to be measured.
    """

    n_episodes: Count
    success_once: Count
    success_at_end: Count | None
    first_choice: Count | None
    chance: Rate | None


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskAudit:
    """The counts of all controls on one task of this version under one protocol, and the verdict.

    Attributes:
        verdict: the shortcuts, which need no memory; or that none was found.
    """

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
class _Shipped:
    """So that a message says `audits.0.task`."""

    audits: tuple[TaskAudit, ...]


@functools.cache
def shipped_audits() -> Mapping[tuple[str, AuditProtocol], TaskAudit]:
    """Return (task, protocol) -> the shipped audit of it.

    Raises:
        ReportError: a file is damaged.
    """
    return {(one.task, one.protocol): one for file in (FILE, OFFICIAL_FILE) for one in _read(file)}


def _read(file: Path) -> tuple[TaskAudit, ...]:
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
    return as_dataclass(_Shipped, {"audits": rows}, source).audits


def protocol_of(
    env: Mapping[str, Any], *, is_official: bool = False
) -> AuditProtocol | None:  # Any: arguments of tasks
    """Return the rules that a run's task arguments select; None if they were not audited.

    Args:
        env: the arguments.
        is_official: whether they are of a task of the official package.
    """
    if is_official:
        return "official" if set(env) <= OFFICIAL_ARGUMENTS else None
    if not env:
        return "paper"
    # Success is gated by phase by default, so omitting the argument is strict, too.
    return "strict" if {"phase_gate_success": True, **env} == STRICT else None
