"""The footnote that names the shortcuts by which a table's tasks can be won without remembering."""

from collections.abc import Mapping, Sequence

from vla_eval.results.shipped_audit import AuditProtocol, Verdict, protocol_of, shipped_verdicts
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.catalog import find_task

RULES: Mapping[AuditProtocol, str] = {"paper": "the paper's rule", "strict": "the strict rule"}


def audit_notes(runs: Sequence[StoredRun]) -> list[str]:
    """Quote the shipped audit for the tasks of runs, one note per set of rules.

    Tasks with arguments, in another version than the audited one, or on the fake simulator are skipped.
    """
    found: dict[AuditProtocol, dict[str, Verdict]] = {}
    for run in runs:
        config = run.description.config
        env = config.get("env") or {}
        protocol = protocol_of(env) if isinstance(env, Mapping) else None
        if protocol is None or config.get("simulator") == "fake":
            continue
        for task in sorted({record.task for record in run.records}):
            verdict, spec = shipped_verdicts().get((task, protocol)), find_task(task)
            if verdict is not None and spec is not None and verdict.version == spec.version:
                found.setdefault(protocol, {})[task] = verdict
    return [_note(protocol, found[protocol]) for protocol in RULES if protocol in found]


def _note(protocol: AuditProtocol, verdicts: Mapping[str, Verdict]) -> str:
    tasks_of: dict[tuple[str, ...], list[str]] = {}
    for task, verdict in verdicts.items():
        tasks_of.setdefault(verdict.words, []).append(task)
    said = "; ".join(f"{', '.join(tasks)}: {', '.join(words)}" for words, tasks in tasks_of.items())
    n_episodes = min(verdict.n_episodes for verdict in verdicts.values())
    return (
        f"shortcut audit under {RULES[protocol]}, {n_episodes} episodes per control: {said} (docs/audit.md; "
        "`mikasa-vla audit` runs it again)."
    )
