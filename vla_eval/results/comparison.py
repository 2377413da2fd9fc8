"""Measure one row, and compare it: with baselines on the same episodes, with chance, with the ceiling."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from vla_eval.results.estimates import (
    Interval,
    PairCounts,
    PairedTest,
    estimate_runs,
    holm,
    mcnemar_exact,
    wilson_interval,
)
from vla_eval.results.grouping import RowEpisodes, RowKey
from vla_eval.tasks.catalog import find_task

CHANCE_POLICY = "cue_blind"
CEILING_POLICY = "oracle"
MEMORYLESS_POLICY = "memoryless"
RANDOM_POLICY = "random"
TOUR_POLICY = "tour"

IntervalKind = Literal["wilson", "t_over_runs"]
ChanceSource = Literal["cue_blind", "1/N", "catalogue"]


class Success(NamedTuple):
    """Success once of a row; everything is None without a result."""

    n_success_once: int | None = None  # how many episodes succeeded at any step
    success_once: float | None = None  # their share; over several runs the mean of the run means
    # `ci_low`, `ci_high`, `interval`: its 95 % interval, and the kind of the interval
    ci_low: float | None = None
    ci_high: float | None = None
    interval: IntervalKind | None = None
    n_runs: int = 0  # independent runs with a result
    sem: float | None = None  # standard error over them


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """A row against another one, on the same episodes; `corrected_p` is Holm's, over the whole table."""

    baseline: RowKey
    pairs: PairCounts
    test: PairedTest
    corrected_p: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Chance:
    """Success without memory, and its source; the interval if it was measured."""

    rate: float
    source: ChanceSource
    interval: Interval | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What the statistics of one row are estimated from."""

    episodes: RowEpisodes
    success: Success  # how often they succeed
    # `chance`, `ceiling`: success without memory, and of the oracle, in the setting of the row
    chance: Chance | None
    ceiling: float | None
    # with each baseline of the table; None where there is no pair of episodes
    comparisons: tuple[Comparison | None, ...]


def success_of(group: RowEpisodes) -> Success:
    """Estimate success once: of several runs the mean of the run means.

    If these are all equal, the episodes of one run give the interval (docs/statistics.md).
    """
    runs = group.runs_with_results
    if not all(run.has_success for run in runs):
        return Success(n_runs=len(runs))
    estimate = estimate_runs([run.rate for run in runs])
    if estimate is None:
        return Success()
    smallest = min(runs, key=lambda run: len(run.results))
    one_run = wilson_interval(smallest.n_success, len(smallest.results))
    interval = estimate.interval if estimate.sem else one_run
    assert interval is not None  # there is a result
    return Success(
        n_success_once=sum(run.n_success for run in runs),
        success_once=estimate.mean,
        ci_low=interval.low,
        ci_high=interval.high,
        interval="t_over_runs" if estimate.sem else "wilson",
        n_runs=len(runs),
        sem=estimate.sem,
    )


def compare[K](pairs: Mapping[K, tuple[RowEpisodes, RowEpisodes]]) -> dict[K, Comparison]:
    """Compare rows with others on the same run and seed; the p values are corrected together."""
    counts = {place: count_pairs(*pair) for place, pair in pairs.items()}
    tests = {place: test for place, found in counts.items() if (test := mcnemar_exact(found)) is not None}
    corrected = holm([test.p_value for test in tests.values()])
    return {
        place: Comparison(baseline=pairs[place][1].key, pairs=counts[place], test=test, corrected_p=p)
        for (place, test), p in zip(tests.items(), corrected, strict=True)
    }


def compare_with_baselines(
    groups: Mapping[RowKey, RowEpisodes], baselines: Sequence[str]
) -> dict[RowKey, tuple[Comparison | None, ...]]:
    """Compare all rows with each baseline policy on the same task, variant, run and seed, no pair twice."""
    found = compare(
        {
            (baseline, key): (group, other)
            for rank, baseline in enumerate(baselines)
            for key, group in groups.items()
            if key.policy not in baselines[rank + 1 :]
            and (other := _baseline_of(key, groups, baseline)) is not None
        }
    )
    return {key: tuple(found.get((baseline, key)) for baseline in baselines) for key in groups}


def gather_evidence(
    groups: Mapping[RowKey, RowEpisodes], compared: Mapping[RowKey, tuple[Comparison | None, ...]]
) -> dict[RowKey, Evidence]:
    """Return what the statistics of each row are estimated from."""
    successes = {key: success_of(group) for key, group in groups.items()}
    return {
        key: Evidence(
            episodes=group,
            success=successes[key],
            chance=chance_of(key, groups, successes),
            ceiling=successes.get(key._replace(policy=CEILING_POLICY), Success()).success_once,
            comparisons=compared[key],
        )
        for key, group in groups.items()
    }


def chance_of(
    key: RowKey, groups: Mapping[RowKey, RowEpisodes], successes: Mapping[RowKey, Success]
) -> Chance | None:
    """Return the success without memory in this row's setting: of the cue-blind arm, or else as stated."""
    blind = successes.get(key._replace(policy=CHANCE_POLICY), Success())
    if blind.success_once is not None and blind.ci_low is not None and blind.ci_high is not None:
        interval = Interval(blind.ci_low, blind.ci_high)
        return Chance(rate=blind.success_once, source="cue_blind", interval=interval)
    place = (key.task, key.variant)
    alike = (group for other, group in groups.items() if (other.task, other.variant) == place)
    records = [record for group in alike for record in group.results]
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
    others = {run.key: run.results for run in other.runs}
    outcomes = []
    seen: set[tuple[int, str, str]] = set()
    for run in group.runs:
        partner = others.get(run.key, {})
        for seed, record in run.results.items():
            if seed not in partner or record.success_once is None:
                continue
            first, second = record.trajectory_sha256, partner[seed].trajectory_sha256
            if first is not None and second is not None:
                # Two deterministic policies give the same pair in every run; this is one observation.
                if (seed, first, second) in seen:
                    continue
                seen.add((seed, first, second))
            outcomes.append((record.outcome == "success", partner[seed].outcome == "success"))
    return PairCounts.of(outcomes)
