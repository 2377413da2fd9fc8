"""Build the success table of one or more run folders; `render` writes it as text.

Reads and returns; changes nothing. `docs/statistics.md` explains each column.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from vla_eval.errors import ReportError, unknown_name
from vla_eval.results import notes
from vla_eval.results.audit_notes import audit_notes
from vla_eval.results.comparison import (
    CHANCE_POLICY,
    RANDOM_POLICY,
    Chance,
    Comparison,
    Measured,
    ceiling_of,
    chance_of,
    compare_with_baselines,
    measure,
)
from vla_eval.results.estimates import chance_corrected
from vla_eval.results.grouping import RowEpisodes, group_runs
from vla_eval.results.published.protocol_summary import protocol_summaries
from vla_eval.results.success_table import Row, RunRow, Table
from vla_eval.results.table_formats import FORMATS, Format, render
from vla_eval.storage.run_folder import StoredRun

__all__ = ["DEFAULT_BASELINES", "FORMATS", "Format", "Row", "Table", "build_table", "render"]

DEFAULT_BASELINES = (CHANCE_POLICY, RANDOM_POLICY)


def build_table(
    runs: Sequence[StoredRun], *, baseline: str | None = None, protocols: Sequence[str] = ()
) -> Table:
    """Build one table of all episodes of the given runs.

    Args:
        runs: what the run folders hold; a folder given twice counts once.
        baseline: the policy with which all others are compared. By default `cue_blind` and `random`, as
            far as they were run.
        protocols: names of protocols whose summary figures are added to those that the runs name.

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
    measured = {key: measure(group) for key, group in grouping.groups.items()}
    chances = {key: chance_of(key, grouping.groups, measured) for key in grouping.groups}
    around = {key: _Around(chances[key], ceiling_of(key, measured)) for key in grouping.groups}
    rows = [
        Row(**_cells(group, measured[key], around[key], [compared[name].get(key) for name in baselines]))
        for key, group in grouping.groups.items()
    ]
    summaries = protocol_summaries(runs, grouping, names=protocols)
    table_notes = (
        *audit_notes(runs),
        *notes.row_notes(rows, chances),
        *notes.comparison_notes(rows, compared),
        *notes.run_notes(runs, grouping),
        *summaries.notes,
    )
    return Table(
        rows=tuple(rows),
        run_rows=tuple(
            RunRow(**_cells(alone, measure(alone), around[key], ()), run=run.index, copy=run.copy)
            for key, group in grouping.groups.items()
            if measured[key].n_runs > 1
            for run in group.runs
            for alone in [replace(group, runs=(run,))]
        ),
        notes=table_notes,
        baselines=baselines,
        n_comparisons=sum(len(found) for found in compared.values()),
        runs={str(run.path): run.description.name for run in runs},
        protocols=summaries.rows,
    )


class _Around(NamedTuple):
    """What a rate is compared with."""

    chance: Chance | None
    ceiling: float | None


def _cells(
    group: RowEpisodes, own: Measured, around: _Around, versus: Sequence[Comparison | None]
) -> dict[str, Any]:  # Any: the fields of `Row`
    right = own.right_if_chose_interval
    chance, ceiling = around
    first, second = (*(_versus(one) for one in versus), _versus(None), _versus(None))[:2]
    return dict(
        **group.key._asdict(),
        n_episodes=len(group.results),
        n_errors=group.n_errors,
        n_success_once=own.n_success_once,
        success_once=own.success_once,
        ci_low=own.interval.low if own.interval else None,
        ci_high=own.interval.high if own.interval else None,
        interval=own.interval_kind,
        n_runs=own.n_runs,
        sem=own.sem,
        success_at_end=own.success_at_end,
        first_choice_success=own.first_choice_success,
        n_chose=own.n_chose,
        n_chose_right=own.n_chose_right,
        right_if_chose=own.right_if_chose,
        right_if_chose_low=right.low if right else None,
        right_if_chose_high=right.high if right else None,
        mean_success_step=own.mean_success_step,
        inferences_per_episode=own.inferences_per_episode,
        baseline=first.baseline,
        baseline_n_action_steps=first.n_action_steps,
        paired_difference=first.difference,
        paired_low=first.low,
        paired_high=first.high,
        n_pairs=first.n_pairs,
        paired_p=first.p,
        paired_p_raw=first.p_raw,
        second_baseline=second.baseline,
        second_n_action_steps=second.n_action_steps,
        second_difference=second.difference,
        second_low=second.low,
        second_high=second.high,
        second_n_pairs=second.n_pairs,
        second_p=second.p,
        second_p_raw=second.p_raw,
        chance=chance.rate if chance else None,
        chance_source=chance.source if chance else None,
        ceiling=ceiling,
        chance_corrected=chance_corrected(
            own.success_once, chance=chance.rate if chance else None, ceiling=ceiling
        ),
    )


class _Versus(NamedTuple):
    """The cells of one comparison; all None without one."""

    baseline: str | None = None
    n_action_steps: int | None = None
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    n_pairs: int | None = None
    p: float | None = None
    p_raw: float | None = None


def _versus(comparison: Comparison | None) -> _Versus:
    if comparison is None:
        return _Versus()
    test = comparison.test
    return _Versus(
        baseline=comparison.baseline.policy,
        n_action_steps=comparison.baseline.n_action_steps,
        difference=test.difference,
        low=test.interval.low,
        high=test.interval.high,
        n_pairs=test.n_pairs,
        p=comparison.corrected_p,
        p_raw=test.p_value,
    )
