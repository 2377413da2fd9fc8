"""The statistics of a row's own episodes, and the footnotes on them."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from vla_eval.base_tasks.catalog import base_task
from vla_eval.errors import some_of
from vla_eval.records import EpisodeRecord
from vla_eval.results.comparison import Evidence, Success
from vla_eval.results.estimates import mean_return, wilson_interval
from vla_eval.results.grouping import RowEpisodes
from vla_eval.results.printed_table import UNDEFINED, Column
from vla_eval.results.success_table import Row, Statistic
from vla_eval.tasks.catalog import find_task


class Episodes(NamedTuple):
    """How many episodes have a result, and how many have none and are in no rate."""

    n_episodes: int
    n_errors: int


class Choices(NamedTuple):
    """First choices; None without candidates."""

    # `n_chose`, `n_chose_right`: how many touched any candidate, and in how many of these the first was
    # right
    n_chose: int | None
    n_chose_right: int | None
    # the share of the latter; right_if_chose_low, right_if_chose_high: its 95 % Wilson interval, of one
    # run
    right_if_chose: float | None
    right_if_chose_low: float | None
    right_if_chose_high: float | None


class Return(NamedTuple):
    """Mean return, its 95 % interval, and where it lies between the best without memory and the best."""

    mean: float | None = None
    ci_low: float | None = None
    ci_high: float | None = None
    normalised: float | None = None


def rate(value: float | None) -> str:
    """Return a rate with two digits, or a dash."""
    return UNDEFINED if value is None else f"{value + 0.0:.2f}".replace("-0.00", "0.00")


def count(n: int, noun: str) -> str:
    """Return a number and its noun, in the plural unless it is one."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _count(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value:.1f}"


def _choices(of: Evidence) -> Choices:
    results = of.episodes.results
    chose = [record for record in results if record.first_choice is not None]
    has_candidates = any(record.first_choice_success is not None for record in results)
    n_right = sum(bool(record.first_choice_success) for record in chose)
    interval = wilson_interval(n_right, len(chose)) if of.success.n_runs == 1 else None
    return Choices(
        n_chose=len(chose) if has_candidates else None,
        n_chose_right=n_right if has_candidates else None,
        right_if_chose=n_right / len(chose) if chose else None,
        right_if_chose_low=interval.low if interval else None,
        right_if_chose_high=interval.high if interval else None,
    )


def _mean_over_runs(group: RowEpisodes, value: Callable[[EpisodeRecord], float | None]) -> float | None:
    runs = group.runs_with_results
    means = [mean for run in runs if (mean := _mean(run.results.values(), value)) is not None]
    return math.fsum(means) / len(means) if means and len(means) == len(runs) else None


def _mean(records: Iterable[EpisodeRecord], value: Callable[[EpisodeRecord], float | None]) -> float | None:
    """Return the mean of a value; None if any record has none: without those it would be biased."""
    values = [value(record) for record in records]
    known = [float(item) for item in values if item is not None]
    return math.fsum(known) / len(known) if values and len(known) == len(values) else None


def mean_text(mean: float | None, sem: float | None, low: float | None, high: float | None) -> str:
    """Return `0.50 ± 0.10 [0.07, 0.93]`, without the standard error of a single run; or a dash."""
    spread = "" if sem is None else f" ± {sem:.2f}"
    return UNDEFINED if mean is None else f"{mean:.2f}{spread} [{rate(low)}, {rate(high)}]"


def _return(of: Evidence) -> Return:
    """Estimate the mean return of MIKASA-Base; robots' rewards are for training and no score."""
    spec = find_task(of.episodes.key.task)
    if spec is None or not spec.is_base or not of.episodes.results:
        return Return()
    runs = [
        [value for one in run.results.values() if (value := one.episode_return) is not None]
        for run in of.episodes.runs_with_results
    ]
    found = mean_return(runs)
    figures = base_task(spec.id).figures
    return Return(found.mean, found.interval.low, found.interval.high, figures.normalised(found.mean))


def _shown_return(row: Row) -> str:
    mean, low, high, _ = row[RETURN]
    return UNDEFINED if mean is None else f"{mean:.3g} [{low:.3g}, {high:.3g}]"


def _return_notes(rows: Sequence[Row]) -> Iterator[str]:
    found = [row for row in rows if row[RETURN].mean is not None]
    if found:
        yield (
            "mean return: with its 95 % t interval, over the episodes of one run or the means of several. "
            "normalised: (R - R_memoryless) / (R_best - R_memoryless), unclipped, by the constants of the "
            "task (`mikasa-vla show TASK`); — where the best policy without memory is not known, or as good "
            "as any."
        )


def _shown_success(row: Row) -> str:
    success = row[SUCCESS]
    return mean_text(success.success_once, success.sem, success.ci_low, success.ci_high)


def _shown_right(row: Row) -> str:
    share, low, high = row[CHOICES][2:]
    return rate(share) if low is None else f"{rate(share)} [{rate(low)}, {rate(high)}]"


def _shown_episodes(row: Row) -> str:
    n_episodes, n_runs = row[EPISODES].n_episodes, row[SUCCESS].n_runs
    return f"{n_episodes} ({n_runs} runs)" if n_runs > 1 else str(n_episodes)


def _interval_notes(rows: Sequence[Row]) -> Iterator[str]:
    found = [row[SUCCESS] for row in rows]
    if any(one.interval == "wilson" and one.n_runs == 1 for one in found):
        yield "success once, one run: 95 % Wilson interval over its episodes."
    if any(one.interval == "t_over_runs" for one in found):
        yield (
            "success once, several runs: mean of the run means ± SEM over the runs, 95 % t interval over the "
            "run means."
        )
    without_spread = [row.key for row in rows if row[SUCCESS].n_runs > 1 and row[SUCCESS].sem == 0]
    if without_spread:
        yield (
            f"SEM is exactly 0 for {some_of(map(str, without_spread))}: all runs have the same "
            "rate. Scripted deterministic controls do not vary between runs, and more runs of them add "
            "nothing. Their interval is Wilson's over the episodes of one run."
        )


def _error_notes(rows: Sequence[Row]) -> Iterator[str]:
    n_errors = sum(row[EPISODES].n_errors for row in rows)
    if n_errors:
        yield (
            f"errors: {count(n_errors, 'episode')} without a result, in no rate, neither as success nor as "
            "failure; the same `mikasa-vla eval` command runs such episodes again."
        )


EPISODES: Statistic[Episodes] = Statistic(
    estimate=lambda of: Episodes(len(of.episodes.results), of.episodes.n_errors),
    cells=lambda value: value._asdict(),
    columns=(
        Column("episodes", _shown_episodes, name="episodes", folds=True, is_last=True),
        Column("errors", lambda row: str(row[EPISODES].n_errors), name="errors", folds=True, is_last=True),
    ),
    notes=_error_notes,
)
SUCCESS: Statistic[Success] = Statistic(
    estimate=lambda of: of.success,
    cells=lambda value: value._asdict(),
    columns=(Column("success once", _shown_success, name="success"),),
    notes=_interval_notes,
)
AT_END: Statistic[float | None] = Statistic(
    estimate=lambda of: _mean_over_runs(of.episodes, lambda record: record.success_at_end),
    cells=lambda value: {"success_at_end": value},
    columns=(Column("at end", lambda row: rate(row[AT_END]), name="at_end", rank=7),),
)
FIRST_CHOICE: Statistic[float | None] = Statistic(
    estimate=lambda of: _mean_over_runs(of.episodes, lambda record: record.first_choice_success),
    cells=lambda value: {"first_choice_success": value},
    columns=(Column("1st choice", lambda row: rate(row[FIRST_CHOICE]), name="first_choice", rank=2),),
)
CHOICES: Statistic[Choices] = Statistic(
    estimate=_choices,
    cells=lambda value: value._asdict(),
    columns=(
        Column(
            "chose",
            lambda row: UNDEFINED if row[CHOICES].n_chose is None else str(row[CHOICES].n_chose),
            name="chose",
            rank=2,
            is_extra=True,
        ),
        Column("right if chose", _shown_right, name="right_if_chose", rank=2, is_extra=True),
    ),
)
RETURN: Statistic[Return] = Statistic(
    estimate=_return,
    cells=lambda value: {f"return_{name}": number for name, number in value._asdict().items()},
    columns=(
        Column("mean return", _shown_return, name="return"),
        Column("normalised", lambda row: rate(row[RETURN].normalised), name="normalised"),
    ),
    notes=_return_notes,
)
STEPS: Statistic[float | None] = Statistic(
    estimate=lambda of: _mean(
        [record for record in of.episodes.results if record.success_once], lambda record: record.success_step
    ),
    cells=lambda value: {"mean_success_step": value},
    columns=(Column("steps", lambda row: _count(row[STEPS]), name="steps", rank=6),),
)
INFERENCES: Statistic[float | None] = Statistic(
    estimate=lambda of: _mean(of.episodes.results, lambda record: record.n_inferences),
    cells=lambda value: {"inferences_per_episode": value},
    columns=(Column("infer.", lambda row: _count(row[INFERENCES]), name="inferences", rank=8),),
)
