"""Build the success table of one or more run folders; `render` writes it as text.

Reads and returns; changes nothing. `docs/statistics.md` explains each column.
"""

from collections.abc import Mapping, Sequence

from vla_eval.errors import ReportError, unknown_name
from vla_eval.results import notes
from vla_eval.results.audit_notes import audit_notes
from vla_eval.results.comparison import (
    Chance,
    Comparison,
    Measured,
    ceiling_of,
    chance_of,
    compare_with_baseline,
    measure,
)
from vla_eval.results.estimates import chance_corrected
from vla_eval.results.grouping import RowEpisodes, RowKey, group_runs
from vla_eval.results.success_table import Row, Table
from vla_eval.results.table_formats import FORMATS, Format, render
from vla_eval.storage.run_folder import StoredRun

__all__ = ["DEFAULT_BASELINE", "FORMATS", "Format", "Row", "Table", "build_table", "render"]

DEFAULT_BASELINE = "random"


def build_table(runs: Sequence[StoredRun], *, baseline: str | None = None) -> Table:
    """Build one table of all episodes of the given runs.

    Args:
        runs: what the run folders hold; a folder given twice counts once.
        baseline: the policy with which all others are compared. By default `random`, or no comparison if
            it was not run.

    Raises:
        ReportError: there is no episode yet.
        UnknownNameError: the requested baseline is not in the runs.
    """
    runs = list({run.path.resolve(): run for run in runs}.values())
    if not any(run.records for run in runs):
        paths = ", ".join(str(run.path) for run in runs) or "no run folder"
        raise ReportError(f"{paths}: there is no episode to report yet. Run one with `mikasa-vla eval`.")
    grouping = group_runs(runs)
    policies = dict.fromkeys(key.policy for key in grouping.groups)
    if baseline is not None and baseline not in policies:
        raise unknown_name("policy", baseline, policies, where="--baseline")
    name = DEFAULT_BASELINE if baseline is None else baseline
    comparisons = compare_with_baseline(grouping.groups, name)
    measured = {key: measure(group) for key, group in grouping.groups.items()}
    chances = {key: chance_of(key, grouping.groups, measured) for key in grouping.groups}
    rows = [
        _row(group, measured, chance=chances[key], comparison=comparisons.get(key))
        for key, group in grouping.groups.items()
    ]
    table_notes = (
        *notes.row_notes(rows, chances),
        *notes.comparison_notes(rows, comparisons, name),
        *audit_notes(runs),
        *notes.run_notes(runs, grouping),
    )
    return Table(
        rows=tuple(rows),
        notes=table_notes,
        baseline=name if name in policies else None,
        n_comparisons=len(comparisons),
        runs={str(run.path): run.description.name for run in runs},
    )


def _row(
    group: RowEpisodes,
    measured: Mapping[RowKey, Measured],
    *,
    chance: Chance | None,
    comparison: Comparison | None,
) -> Row:
    own = measured[group.key]
    right = own.right_if_chose_interval
    ceiling = ceiling_of(group.key, measured)
    test = comparison.test if comparison else None
    return Row(
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
        baseline=comparison.baseline.policy if comparison else None,
        baseline_n_action_steps=comparison.baseline.n_action_steps if comparison else None,
        paired_difference=test.difference if test else None,
        n_pairs=test.n_pairs if test else None,
        paired_p=comparison.corrected_p if comparison else None,
        paired_p_raw=test.p_value if test else None,
        chance=chance.rate if chance else None,
        chance_source=chance.source if chance else None,
        ceiling=ceiling,
        chance_corrected=chance_corrected(
            own.success_once, chance=chance.rate if chance else None, ceiling=ceiling
        ),
    )
