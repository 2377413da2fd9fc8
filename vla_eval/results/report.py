"""Build the success table of run folders; `docs/statistics.md` explains each column."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from vla_eval.errors import ReportError, unknown_name
from vla_eval.results.comparison import (
    CHANCE_POLICY,
    MEMORYLESS_POLICY,
    RANDOM_POLICY,
    Evidence,
    compare_with_baselines,
    gather_evidence,
    success_of,
)
from vla_eval.results.formats import FORMATS, Format
from vla_eval.results.grouping import RowKey, group_runs
from vla_eval.results.latex_preset import CONTROLS
from vla_eval.results.notes import run_notes
from vla_eval.results.passport.passport import Passport
from vla_eval.results.passport.ranking import not_ranked
from vla_eval.results.published.protocol_summary import protocol_summaries
from vla_eval.results.shipped_audit import (
    OTHER_VERDICTS,
    PROTOCOLS,
    ROADS,
    STORED,
    AuditProtocol,
    TaskAudit,
    protocol_of,
    shipped_audits,
    stored_frames,
)
from vla_eval.results.side_by_side.of_row import passports_of
from vla_eval.results.statistics import make_row, row_notes
from vla_eval.results.success_table import Row, Table
from vla_eval.results.table_formats import render
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.catalog import find_task

__all__ = ["DEFAULT_BASELINES", "FORMATS", "Format", "Row", "Table", "build_table", "render"]

DEFAULT_BASELINES = (CHANCE_POLICY, MEMORYLESS_POLICY, RANDOM_POLICY)


def build_table(
    runs: Sequence[StoredRun], *, baseline: str | None = None, protocols: Sequence[str] = ()
) -> Table:
    """Build one table of all episodes of the given runs; a folder given twice counts once.

    All policies are compared with `baseline`, by default with those of `DEFAULT_BASELINES`
    that were run.
    The summary figures of these protocols are added to those that the runs name.

    Raises:
        ReportError: there is no episode yet.
        UnknownNameError: the requested baseline is not in the runs, or a requested protocol does not exist.
    """
    runs = list({run.path.resolve(): run for run in runs}.values())
    if not any(run.records for run in runs):
        paths = ", ".join(str(run.path) for run in runs) or "no run folder"
        raise ReportError(f"{paths}: there is no episode to report yet. Run one with `mikasa-vla eval`.")
    grouping = group_runs(runs)
    policies = dict.fromkeys(key.policy for key in grouping.groups)
    if baseline is not None and baseline not in policies:
        raise unknown_name("policy", baseline, policies, where="--baseline")
    baselines = (
        tuple(name for name in DEFAULT_BASELINES if name in policies) if baseline is None else (baseline,)
    )
    compared = compare_with_baselines(grouping.groups, baselines)
    evidence = gather_evidence(grouping.groups, compared).values()
    rows = tuple(map(make_row, evidence))
    summaries = protocol_summaries(runs, grouping, names=protocols)
    passports = passports_of(grouping)
    return Table(
        rows=rows,
        run_rows=tuple(row for of in evidence if of.success.n_runs > 1 for row in _run_rows(of)),
        notes=(
            *audit_notes(runs),
            *row_notes(rows),
            *not_ranked(_ranked_rows(passports)),
            *run_notes(runs, grouping),
            *summaries.notes,
        ),
        baselines=baselines,
        n_comparisons=sum(one is not None for found in compared.values() for one in found),
        runs={str(run.path): run.description.name for run in runs},
        protocols=summaries.rows,
        passports=passports,
    )


def _ranked_rows(passports: Mapping[RowKey, Passport]) -> dict[str, list[Passport]]:
    """Return task -> the passports of its rows, but those of controls, which no one ranks."""
    found: dict[str, list[Passport]] = {}
    for key, one in passports.items():
        if key.policy not in CONTROLS:
            found.setdefault(key.task, []).append(one)
    return found


def _run_rows(of: Evidence) -> list[Row]:
    """Return a row for each run, compared with nothing, so that no test counts twice."""
    rows, nothing = [], (None,) * len(of.comparisons)
    for run in of.episodes.runs:
        own = replace(of.episodes, runs=(run,))
        alone = replace(of, episodes=own, success=success_of(own), comparisons=nothing)
        rows.append(make_row(alone, run=run))
    return rows


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
    said += _stored(audits)
    n_episodes = min((audit.n_episodes for audit in audits.values() if audit.n_episodes), default=0)
    rules = PROTOCOLS[protocol]
    under = f"audit under {rules.words}, {n_episodes} episodes per control: {rules.page}"
    return f"{'; '.join(said)} ({under})."


def _stored(audits: Mapping[str, TaskAudit]) -> list[str]:
    """Say of which tasks one frame has to be stored, and of which several."""
    found: dict[str, list[str]] = {}
    for task, audit in audits.items():
        frames = stored_frames().get(task)
        if frames is not None and frames.version == audit.version and frames.verdict in STORED:
            found.setdefault(frames.verdict, []).append(task)
    return [f"{STORED[verdict]} {', '.join(tasks)}" for verdict, tasks in sorted(found.items())]
