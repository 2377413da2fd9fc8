"""Build the success table of run folders; `docs/statistics.md` explains each column."""

from collections.abc import Sequence
from dataclasses import replace

from vla_eval.errors import ReportError, unknown_name
from vla_eval.results.audit_notes import audit_notes
from vla_eval.results.comparison import (
    CHANCE_POLICY,
    RANDOM_POLICY,
    Evidence,
    compare_with_baselines,
    gather_evidence,
    success_of,
)
from vla_eval.results.formats import FORMATS, Format
from vla_eval.results.grouping import group_runs
from vla_eval.results.notes import run_notes
from vla_eval.results.published.protocol_summary import protocol_summaries
from vla_eval.results.statistics import make_row, row_notes
from vla_eval.results.success_table import Row, Table
from vla_eval.results.table_formats import render
from vla_eval.storage.run_folder import StoredRun

__all__ = ["DEFAULT_BASELINES", "FORMATS", "Format", "Row", "Table", "build_table", "render"]

DEFAULT_BASELINES = (CHANCE_POLICY, RANDOM_POLICY)


def build_table(
    runs: Sequence[StoredRun], *, baseline: str | None = None, protocols: Sequence[str] = ()
) -> Table:
    """Build one table of all episodes of the given runs; a folder given twice counts once.

    All policies are compared with `baseline`, by default with `cue_blind` and `random`, if they were run.
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
    return Table(
        rows=rows,
        run_rows=tuple(row for of in evidence if of.success.n_runs > 1 for row in _run_rows(of)),
        notes=(*audit_notes(runs), *row_notes(rows), *run_notes(runs, grouping), *summaries.notes),
        baselines=baselines,
        n_comparisons=sum(one is not None for found in compared.values() for one in found),
        runs={str(run.path): run.description.name for run in runs},
        protocols=summaries.rows,
    )


def _run_rows(of: Evidence) -> list[Row]:
    """Return a row for each run, compared with nothing, so that no test counts twice."""
    rows, nothing = [], (None,) * len(of.comparisons)
    for run in of.episodes.runs:
        own = replace(of.episodes, runs=(run,))
        alone = replace(of, episodes=own, success=success_of(own), comparisons=nothing)
        rows.append(make_row(alone, run=run))
    return rows
