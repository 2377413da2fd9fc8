"""Measure one row, and compare it: with baselines on the same episodes, with chance, with the ceiling."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import (
    Interval,
    PairCounts,
    PairedTest,
    estimate_runs,
    holm,
    mcnemar_exact,
    wilson_interval,
)
from vla_eval.results.grouping import RowEpisodes, RowKey, Run
from vla_eval.results.success_table import ChanceSource, IntervalKind
from vla_eval.tasks.catalog import find_task

CHANCE_POLICY = "cue_blind"
CEILING_POLICY = "oracle"
RANDOM_POLICY = "random"
TOUR_POLICY = "tour"


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """Estimates from one row's own episodes; everything is None without a result."""

    n_runs: int
    n_success_once: int | None = None
    success_once: float | None = None
    interval: Interval | None = None
    interval_kind: IntervalKind | None = None
    sem: float | None = None
    success_at_end: float | None = None
    first_choice_success: float | None = None
    n_chose: int | None = None
    n_chose_right: int | None = None
    right_if_chose: float | None = None
    right_if_chose_interval: Interval | None = None
    mean_success_step: float | None = None
    inferences_per_episode: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """A row against the baseline."""

    baseline: RowKey
    test: PairedTest
    corrected_p: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Chance:
    """Success without memory, and its source; the interval if it was measured."""

    rate: float
    source: ChanceSource
    interval: Interval | None = None


def measure(group: RowEpisodes) -> Measured:
    """Estimate all rates of a row.

    Rates of several runs are means of the run means. If these are all equal, a t interval would have zero
    width, as if there were no uncertainty; then the episodes of one run give the interval.
    """
    runs = [run for run in group.runs if run.results]
    estimate = estimate_runs([_n_success(run.results.values()) / len(run.results) for run in runs])
    if estimate is None:
        return Measured(n_runs=0)
    kind: IntervalKind = "t_over_runs" if estimate.sem else "wilson"
    smallest = min((run.results.values() for run in runs), key=len)
    one_run = wilson_interval(_n_success(smallest), len(smallest))
    results = group.results
    chose = [record for record in results if record.first_choice is not None]
    has_candidates = any(record.first_choice_success is not None for record in results)
    n_right = sum(bool(record.first_choice_success) for record in chose)
    return Measured(
        n_runs=len(runs),
        n_success_once=_n_success(results),
        success_once=estimate.mean,
        interval=estimate.interval if kind == "t_over_runs" else one_run,
        interval_kind=kind,
        sem=estimate.sem,
        success_at_end=_mean_over_runs(runs, lambda record: record.success_at_end),
        first_choice_success=_mean_over_runs(runs, lambda record: record.first_choice_success),
        n_chose=len(chose) if has_candidates else None,
        n_chose_right=n_right if has_candidates else None,
        right_if_chose=n_right / len(chose) if chose else None,
        right_if_chose_interval=wilson_interval(n_right, len(chose)) if len(runs) == 1 else None,
        mean_success_step=_rate([r for r in results if r.success_once], lambda record: record.success_step),
        inferences_per_episode=_rate(results, lambda record: record.n_inferences),
    )


def compare_with_baselines(
    groups: Mapping[RowKey, RowEpisodes], baselines: Sequence[str]
) -> dict[str, dict[RowKey, Comparison]]:
    """Compare every other policy with each baseline, on the same task, variant, run and seed.

    No pair of policies is tested twice: a baseline is not compared with those before it.

    Args:
        groups: all rows.
        baselines: names of the policies to compare with.

    Returns:
        Baseline -> one comparison per row that shares episodes with it; p values are corrected for all
        comparisons with all baselines.
    """
    found: dict[tuple[str, RowKey], tuple[RowKey, PairedTest]] = {}
    for rank, baseline in enumerate(baselines):
        for key, group in groups.items():
            other = None if key.policy in baselines[rank + 1 :] else _baseline_of(key, groups, baseline)
            test = mcnemar_exact(count_pairs(group, other)) if other is not None else None
            if other is not None and test is not None:
                found[baseline, key] = (other.key, test)
    corrected = holm([test.p_value for _, test in found.values()])
    compared: dict[str, dict[RowKey, Comparison]] = {baseline: {} for baseline in baselines}
    for ((baseline, key), (other_key, test)), p in zip(found.items(), corrected, strict=True):
        compared[baseline][key] = Comparison(baseline=other_key, test=test, corrected_p=p)
    return compared


def chance_of(
    key: RowKey, groups: Mapping[RowKey, RowEpisodes], measured: Mapping[RowKey, Measured]
) -> Chance | None:
    """Return the success of a policy without memory in the setting of this row.

    It is that of the cue-blind arm on the same task, variant and `n_action_steps`, if it was run; otherwise
    the value of the records or the catalogue (1/N for N candidates); None if there are no candidates.
    """
    cue_blind = measured.get(key._replace(policy=CHANCE_POLICY))
    if cue_blind is not None and cue_blind.success_once is not None:
        return Chance(rate=cue_blind.success_once, source="cue_blind", interval=cue_blind.interval)
    records = [
        record
        for other, group in groups.items()
        if (other.task, other.variant) == (key.task, key.variant)
        for record in group.results
    ]
    by_luck = {record.chance_success for record in records if record.chance_success is not None}
    if len(by_luck) == 1:
        return Chance(rate=by_luck.pop(), source="1/N")
    # Records of earlier versions do not have it; their tasks had one right candidate.
    n_candidates = {record.n_candidates for record in records if record.n_candidates}
    if len(n_candidates) == 1:
        return Chance(rate=1 / n_candidates.pop(), source="1/N")
    spec = find_task(key.task)
    if n_candidates or spec is None or spec.chance_success is None:
        return None
    return Chance(rate=spec.chance_success, source="catalogue")


def ceiling_of(key: RowKey, measured: Mapping[RowKey, Measured]) -> float | None:
    """Return the success of the oracle on the same task, variant and `n_action_steps`."""
    oracle = measured.get(key._replace(policy=CEILING_POLICY))
    return oracle.success_once if oracle is not None else None


def _baseline_of(key: RowKey, groups: Mapping[RowKey, RowEpisodes], baseline: str) -> RowEpisodes | None:
    """Return the baseline's row to compare with: at the same `n_action_steps`, or at the only other one."""
    if key.policy == baseline:
        return None
    same = groups.get(key._replace(policy=baseline))
    if same is not None:
        return same
    others = [
        group
        for other, group in groups.items()
        if (other.task, other.policy, other.variant) == (key.task, baseline, key.variant)
    ]
    return others[0] if len(others) == 1 else None


def count_pairs(group: RowEpisodes, other: RowEpisodes) -> PairCounts:
    """Count the outcomes of two rows on the same run and seed."""
    counts = {(True, True): 0, (True, False): 0, (False, True): 0, (False, False): 0}
    others = {(run.index, run.copy): run.results for run in other.runs}
    seen: set[tuple[int, str, str]] = set()
    for run in group.runs:
        partner = others.get((run.index, run.copy), {})
        for seed, record in run.results.items():
            if seed not in partner:
                continue
            first, second = record.trajectory_sha256, partner[seed].trajectory_sha256
            if first is not None and second is not None:
                # Two deterministic policies give the same pair in every run; this is one observation.
                if (seed, first, second) in seen:
                    continue
                seen.add((seed, first, second))
            counts[_once(record), _once(partner[seed])] += 1
    return PairCounts(*counts.values())


def _once(record: EpisodeRecord) -> bool:
    return record.outcome == "success"


def _n_success(results: Iterable[EpisodeRecord]) -> int:
    return sum(_once(record) for record in results)


def _mean_over_runs(runs: Sequence[Run], value: Callable[[EpisodeRecord], float | None]) -> float | None:
    means = [mean for run in runs if (mean := _rate(run.results.values(), value)) is not None]
    return math.fsum(means) / len(means) if len(means) == len(runs) else None


def _rate(records: Iterable[EpisodeRecord], value: Callable[[EpisodeRecord], float | None]) -> float | None:
    """Return the mean of a value; None if any record has none.

    Excluding those would bias it: with `stop_at_success`, success_at_end is known for failures only.
    """
    values = [value(record) for record in records]
    known = [float(item) for item in values if item is not None]
    return math.fsum(known) / len(known) if values and len(known) == len(values) else None
