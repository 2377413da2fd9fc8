"""The note that says by which shortcuts a table's tasks can be won without memory."""

from collections.abc import Mapping, Sequence

from vla_eval.results.shipped_audit import (
    OTHER_VERDICTS,
    PROTOCOLS,
    ROADS,
    AuditProtocol,
    TaskAudit,
    protocol_of,
    shipped_audits,
)
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.catalog import find_task


def audit_notes(runs: Sequence[StoredRun]) -> list[str]:
    """Quote the shipped audit for the tasks of runs, one note per set of rules.

    Tasks with arguments, in another version than the audited one, or on the fake simulator are skipped.
    """
    found: dict[AuditProtocol, dict[str, TaskAudit]] = {}
    for run in runs:
        config = run.description.config
        env = config.get("env") or {}
        if not isinstance(env, Mapping) or config.get("simulator") == "fake":
            continue
        for task in sorted({record.task for record in run.records}):
            spec = find_task(task)
            protocol = protocol_of(env, is_official=spec is not None and spec.is_official)
            audit = None if protocol is None else shipped_audits().get((task, protocol))
            if spec is not None and audit is not None and audit.version == spec.version:
                found.setdefault(audit.protocol, {})[task] = audit
    return [_note(protocol, found[protocol]) for protocol in PROTOCOLS if protocol in found]


def _note(protocol: AuditProtocol, audits: Mapping[str, TaskAudit]) -> str:
    tasks_of: dict[tuple[str, ...], list[str]] = {}
    for task, audit in audits.items():
        tasks_of.setdefault(tuple(word for word in audit.verdict if word in ROADS), []).append(task)
    won = (
        f"{', '.join(tasks)} {', or '.join(ROADS[word] for word in words)}"
        for words, tasks in tasks_of.items()
        if words
    )
    said = [f"can be won without memory: {'; '.join(won)}"] if any(tasks_of) else []
    for words, meaning in OTHER_VERDICTS.items():
        tasks = [task for task, audit in audits.items() if words in audit.verdict]
        said += [f"{meaning}: {', '.join(tasks)}"] if tasks else []
    n_episodes = min((audit.n_episodes for audit in audits.values() if audit.n_episodes), default=0)
    rules = PROTOCOLS[protocol]
    under = f"audit under {rules.words}, {n_episodes} episodes per control: {rules.page}"
    return f"{'; '.join(said)} ({under})."
