"""The success table as data: its rows and their notes."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Literal

IntervalKind = Literal["wilson", "t_over_runs"]
ChanceSource = Literal["cue_blind", "1/N", "catalogue"]
SummaryInterval = Literal["wilson_over_tasks", "t_over_runs"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One policy on one task, at one `n_action_steps` and one variant of the settings.

    `docs/statistics.md` says what each value means and how it is computed. An undefined value is None.

    Attributes:
        n_episodes: episodes with a result; n_errors: episodes without one, in no rate.
        n_success_once: how many succeeded at any step.
        success_once: their share; over several runs the mean of the run means.
        ci_low, ci_high, interval: its 95 % interval, and the kind of the interval.
        n_runs: independent runs with a result; sem: standard error over them.
        success_at_end: share that succeeded at the last step.
        first_choice_success: share whose first candidate touched was the right one.
        n_chose, n_chose_right: how many touched any candidate, and in how many of these the first was right.
        right_if_chose: the share of the latter; right_if_chose_low, right_if_chose_high: its 95 % Wilson
            interval, of one run.
        mean_success_step: control steps until success, over the successes.
        inferences_per_episode: calls of the policy.
        baseline, baseline_n_action_steps: the row with which this one is compared, on the same episodes.
        paired_difference: this row minus the baseline, over n_pairs pairs; paired_low, paired_high: its 95 %
            interval.
        paired_p, paired_p_raw: exact McNemar, with and without Holm's correction.
        second_baseline … second_p_raw: the same with a second baseline.
        chance, chance_source: success without memory, and its source.
        ceiling: success of the `oracle` at the same n_action_steps.
        chance_corrected: success_once relative to chance (0) and ceiling (1).
        variant: the settings that differ from the others in the table; None if there is only one.
    """

    task: str
    policy: str
    n_action_steps: int
    variant: str | None
    n_episodes: int
    n_errors: int
    n_success_once: int | None
    success_once: float | None
    ci_low: float | None
    ci_high: float | None
    interval: IntervalKind | None
    n_runs: int
    sem: float | None
    success_at_end: float | None
    first_choice_success: float | None
    n_chose: int | None
    n_chose_right: int | None
    right_if_chose: float | None
    right_if_chose_low: float | None
    right_if_chose_high: float | None
    mean_success_step: float | None
    inferences_per_episode: float | None
    baseline: str | None
    baseline_n_action_steps: int | None
    paired_difference: float | None
    paired_low: float | None
    paired_high: float | None
    n_pairs: int | None
    paired_p: float | None
    paired_p_raw: float | None
    second_baseline: str | None
    second_n_action_steps: int | None
    second_difference: float | None
    second_low: float | None
    second_high: float | None
    second_n_pairs: int | None
    second_p: float | None
    second_p_raw: float | None
    chance: float | None
    chance_source: ChanceSource | None
    ceiling: float | None
    chance_corrected: float | None

    def to_dict(self) -> dict[str, str | int | float | None]:
        """Return the row by column name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRow(Row):
    """One run of a row that has several; compared with nothing, so that no test counts twice.

    Attributes:
        run: its number; with several checkpoints, which of them.
        copy: above 0 where further run folders hold the same run with other trajectories or weights.
    """

    run: int
    copy: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtocolRow:
    """The summary figure of one policy at one K.

    Attributes:
        protocol, version: which protocol.
        group: the part of its tasks that the figure is over; None: all.
        policy, n_action_steps, variant: as in the success table.
        n_tasks, n_runs: over how many tasks and runs the figure is.
        mean: mean over the tasks of success once; over several runs the mean of the run means. None where
            something departs from the protocol.
        ci_low, ci_high, interval: its 95 % interval, and the kind of the interval.
        sem: standard error over the runs.
        lowest, highest: of the tasks' rates.
        departures: what is not as the protocol says.
    """

    protocol: str
    version: int
    group: str | None
    policy: str
    n_action_steps: int
    variant: str | None
    n_tasks: int
    n_runs: int
    mean: float | None = None
    ci_low: float | None = None
    ci_high: float | None = None
    interval: SummaryInterval | None = None
    sem: float | None = None
    lowest: float | None = None
    highest: float | None = None
    departures: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows and their notes.

    Attributes:
        rows: in the order of the configuration.
        run_rows: the runs of each row that has several.
        notes: footnotes, whole sentences.
        baselines: the policies with which the others are compared: one, two or none.
        n_comparisons: how many p values were corrected together.
        runs: run folder -> name of its configuration.
        protocols: the summary figures of published protocols, as far as the runs name any.
    """

    rows: tuple[Row, ...]
    run_rows: tuple[RunRow, ...] = ()
    notes: tuple[str, ...]
    baselines: tuple[str, ...]
    n_comparisons: int
    runs: Mapping[str, str]
    protocols: tuple[ProtocolRow, ...] = ()

    def with_runs(self) -> tuple[Row, ...]:
        """Return the rows, each followed by its runs."""
        runs_of: dict[tuple[str, str, int, str | None], list[Row]] = {}
        for run in self.run_rows:
            runs_of.setdefault((run.task, run.policy, run.n_action_steps, run.variant), []).append(run)
        return tuple(
            one
            for row in self.rows
            for one in (row, *runs_of.get((row.task, row.policy, row.n_action_steps, row.variant), ()))
        )
