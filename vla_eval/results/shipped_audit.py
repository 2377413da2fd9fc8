"""The result of the shortcut audit of the shipped tasks: `shipped_audit.json`, made by a command.

    mikasa-vla audit --format json > vla_eval/results/shipped_audit.json

Imports neither statistics nor simulators, so that a report can quote it.
"""

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

AuditProtocol = Literal["paper", "strict"]
STRICT: Mapping[str, bool] = {
    "freeze_until_choice": True,
    "strict_choice": True,
    "phase_gate_success": True,
}
PROTOCOLS: Mapping[AuditProtocol, Mapping[str, bool]] = {"paper": {}, "strict": STRICT}
"""Name of a set of rules -> arguments of the tasks."""

FILE = Path(__file__).with_suffix(".json")


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The audit's verdict on a task.

    Attributes:
        version: of the task, when it was audited.
        words: the shortcuts, which need no memory; or that none was found.
        n_episodes: of each control.
    """

    version: int
    words: tuple[str, ...]
    n_episodes: int


@functools.cache
def shipped_verdicts() -> Mapping[tuple[str, AuditProtocol], Verdict]:
    """Return (task, protocol) -> the verdict of the shipped audit."""
    rows = json.loads(FILE.read_text(encoding="utf-8"))
    return {
        (row["task"], row["protocol"]): Verdict(
            version=row["version"],
            words=tuple(row["verdict"]),
            n_episodes=min(counts["n_episodes"] for counts in row["counts"].values()),
        )
        for row in rows
    }


def protocol_of(env: Mapping[str, Any]) -> AuditProtocol | None:  # Any: arguments of tasks
    """Return the rules that a run's task arguments select; None if they were not audited."""
    if not env:
        return "paper"
    # Success is gated by phase by default, so omitting the argument is strict, too.
    return "strict" if {"phase_gate_success": True, **env} == STRICT else None
