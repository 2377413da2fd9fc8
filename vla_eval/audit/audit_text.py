"""The audit as text: one row per task and protocol, or all counts as JSON."""

import json
from collections.abc import Sequence
from dataclasses import asdict

from vla_eval.audit.evaluations import CONTROLS
from vla_eval.audit.verdicts import ALPHA
from vla_eval.results.shipped_audit import Counts, TaskAudit

COLUMNS = tuple(dict.fromkeys(control for controls in CONTROLS.values() for control in controls))
NOT_PLAYED = "–"


def render_audit(audits: Sequence[TaskAudit], style: str) -> str:
    """Return the audit as `json`, with every count, or as `markdown`."""
    if style == "json":
        return json.dumps([asdict(audit) for audit in audits], indent=2)
    columns = [control for control in COLUMNS if any(control in audit.counts for audit in audits)]
    header = ["task", "protocol", "chance", *columns, "verdict"]
    rows = [header, [":--", ":--", *["--:"] * (1 + len(columns)), ":--"]]
    rows += [_row(audit, columns) for audit in audits]
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([*lines, "", *_notes(audits)])


def _row(audit: TaskAudit, columns: Sequence[str]) -> list[str]:
    chance = "measured" if "cue_blind" in audit.counts else NOT_PLAYED
    if audit.chance is not None:
        chance = f"{100 * audit.chance:.1f}"
    cells = [_cell(audit.counts.get(control)) for control in columns]
    return [audit.task, audit.protocol, chance, *cells, ", ".join(audit.verdict)]


def _cell(counts: Counts | None) -> str:
    if counts is None or counts.n_episodes == 0:
        return NOT_PLAYED
    success = f"{100 * counts.success_once / counts.n_episodes:.0f}"
    if counts.first_choice is None:
        return success
    return f"{success} / {100 * counts.first_choice / counts.n_episodes:.0f}"


def _notes(audits: Sequence[TaskAudit]) -> list[str]:
    episodes = sorted({counts.n_episodes for audit in audits for counts in audit.counts.values()})
    spread = f"{episodes[0]} to {episodes[-1]}" if len(episodes) > 1 else "".join(map(str, episodes))
    notes = [
        f"Success once / right first choices, in percent of {spread} episodes per cell. A shortcut is named "
        f"where its control beats chance (exact binomial test, p < {ALPHA}) or, where that is measured, "
        "the blind arm (Fisher's test); `needs memory`: no such control, and the oracle beats every control."
    ]
    n_errors = sum(audit.n_errors for audit in audits)
    if n_errors:
        notes.append(
            f"{n_errors} episodes ended in an error and are in no cell; the same command retries them."
        )
    return notes
