"""Estimates from counts: intervals, paired tests, corrections. Pure functions of numbers.

scipy and statsmodels compute; ours are the cases that they answer with NaN or rounding. An undefined value
is None, never 0. Knows nothing of episodes, tasks or files.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import scipy

CONFIDENCE = 0.95
LEVEL = 0.05  # of tests


class Interval(NamedTuple):
    """A confidence interval: of a rate within [0, 1], of a difference of two rates within [-1, 1]."""

    low: float
    high: float


class PairCounts(NamedTuple):
    """Outcomes of two policies on the same episodes: in how many both, only one or neither succeeded."""

    both: int
    only_first: int
    only_second: int
    neither: int

    @classmethod
    def of(cls, outcomes: Iterable[tuple[bool, bool]]) -> "PairCounts":
        """Count pairs by whether the first and the second succeeded."""
        counts = Counter(outcomes)
        return cls(*(counts[one, two] for one in (True, False) for two in (True, False)))

    @property
    def n_pairs(self) -> int:
        """The number of pairs."""
        return sum(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunsEstimate:
    """A success rate from several runs: mean of the run means; their SEM and t interval, None for one run."""

    mean: float
    sem: float | None
    interval: Interval | None


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedTest:
    """First minus second policy on the same episodes: 95 % interval, p of the exact McNemar test."""

    difference: float
    interval: Interval
    p_value: float


def wilson_interval(n_success: int, n_episodes: int) -> Interval | None:
    """Return the Wilson score interval of a proportion, at 95 %; None without an episode.

    Source: Wilson 1927, JASA 22(158):209-212; recommended for small n by Brown, Cai & DasGupta 2001,
    Statistical Science 16(2):101-133. Computed by scipy.stats.binomtest.
    """
    if n_episodes == 0:
        return None
    found = scipy.stats.binomtest(n_success, n_episodes).proportion_ci(CONFIDENCE, method="wilson")
    return Interval(float(found.low), float(found.high))


class Share(NamedTuple):
    """How many of how many, with its interval."""

    n: int
    of: int

    @classmethod
    def counted[T](cls, items: Sequence[T], holds: Callable[[T], bool]) -> "Share | None":
        """Return the share of items for which something holds; None without an item."""
        return cls(sum(map(holds, items)), len(items)) if items else None

    @property
    def rate(self) -> float:
        """The share."""
        return self.n / self.of

    @property
    def interval(self) -> Interval:
        """The Wilson interval at 95 %."""
        found = wilson_interval(self.n, self.of)
        assert found is not None  # a share is of at least one
        return found

    def __str__(self) -> str:
        """Return `0.93 [0.84, 0.97]`."""
        low, high = self.interval
        return f"{self.rate:.2f} [{low:.2f}, {high:.2f}]"


def mean_interval(counts: Sequence[tuple[int, int]]) -> Interval:
    """Return the 95 % interval of the mean of independent proportions (successes, episodes), none empty.

    The squares of the distances from each rate to the end of its Wilson interval add up, as variances do.
    The proportions are those asked for and no sample of others: the interval is over episodes alone.

    Source: Zou & Donner 2008, "Construction of confidence limits about effect measures: a general approach",
    Statistics in Medicine 27(10):1693-1702, for a sum of two, here of any number of rates.
    """
    reaches = [_below_and_above(n_success, n_episodes) for n_success, n_episodes in counts]
    mean = math.fsum(n_success / n_episodes for n_success, n_episodes in counts) / len(counts)
    below = math.sqrt(math.fsum(reach.below**2 for reach in reaches)) / len(counts)
    above = math.sqrt(math.fsum(reach.above**2 for reach in reaches)) / len(counts)
    return Interval(max(0.0, mean - below), min(1.0, mean + above))


def estimate_runs(run_means: Sequence[float]) -> RunsEstimate | None:
    """Return mean, SEM and 95 % t interval over the success rates of independent runs; None without any.

    Source: Student's t with n - 1 degrees of freedom over the run means; SEM as in the paper, section
    "Experiments Reproducing and Compute Resources". The interval is clipped to [0, 1].
    """
    n_runs = len(run_means)
    if n_runs == 0:
        return None
    mean = math.fsum(run_means) / n_runs
    if n_runs == 1:
        return RunsEstimate(mean=mean, sem=None, interval=None)
    if min(run_means) == max(run_means):  # exact, because rounding would give a spread of 1e-17
        return RunsEstimate(mean=run_means[0], sem=0.0, interval=Interval(run_means[0], run_means[0]))
    sem = float(scipy.stats.sem(run_means))
    half_width = float(scipy.stats.t.ppf((1 + CONFIDENCE) / 2, n_runs - 1)) * sem
    interval = Interval(max(0.0, mean - half_width), min(1.0, mean + half_width))
    return RunsEstimate(mean=mean, sem=sem, interval=interval)


class MeanReturn(NamedTuple):
    """A mean of returns and its interval."""

    mean: float
    interval: Interval


def mean_return(runs: Sequence[Sequence[float]]) -> MeanReturn:
    """Return the mean of returns, none empty, and its 95 % t interval.

    Of one run over its episodes, of several over the run means. A single value, or values that are all equal,
    have an interval of no width.
    """
    values = [math.fsum(run) / len(run) for run in runs] if len(runs) > 1 else list(runs[0])
    mean = math.fsum(values) / len(values)
    if min(values) == max(values):
        return MeanReturn(values[0], Interval(values[0], values[0]))
    half_width = float(scipy.stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * scipy.stats.sem(values))
    return MeanReturn(mean, Interval(mean - half_width, mean + half_width))


def mcnemar_exact(counts: PairCounts) -> PairedTest | None:
    """Compare two policies on the same episodes; None without a pair.

    Only the pairs in which they differ are informative: if neither policy were better, each of these would
    be the toss of a fair coin. Without any such pair p is 1.

    Source: McNemar 1947, Psychometrika 12:153-157, in its exact form: a two-sided binomial test of
    `only_first` among `only_first + only_second`. Computed by scipy.stats.binomtest.
    """
    if counts.n_pairs == 0:
        return None
    n_different = counts.only_first + counts.only_second
    p_value = float(scipy.stats.binomtest(counts.only_first, n_different).pvalue) if n_different else 1.0
    difference = (counts.only_first - counts.only_second) / counts.n_pairs
    return PairedTest(difference=difference, interval=paired_interval(counts), p_value=min(1.0, p_value))


def paired_interval(counts: PairCounts) -> Interval:
    """Return the interval of a difference of two rates over the same episodes, at least one, at 95 %.

    Wilson's interval of each rate, combined by the correlation of the outcomes. It is not derived from the
    exact test, so close to a difference of 0 the two may disagree.

    Source: Newcombe 1998, "Improved confidence intervals for the difference between binomial proportions
    based on paired data", Statistics in Medicine 17(22):2635-2650, method 10.
    """
    n, n_first, n_second = counts.n_pairs, counts.both + counts.only_first, counts.both + counts.only_second
    first, second = _below_and_above(n_first, n), _below_and_above(n_second, n)
    phi = _correlation(counts)

    def combined(one: float, other: float) -> float:
        return math.sqrt(max(0.0, one**2 - 2 * phi * one * other + other**2))

    low, high = combined(first.below, second.above), combined(first.above, second.below)
    difference = (n_first - n_second) / n
    return Interval(max(-1.0, difference - low), min(1.0, difference + high))


class _Reach(NamedTuple):
    """How far an interval reaches below and above its rate."""

    below: float
    above: float


def _below_and_above(n_success: int, n_episodes: int) -> _Reach:
    interval = wilson_interval(n_success, n_episodes)
    assert interval is not None  # there is a pair
    rate = n_success / n_episodes
    return _Reach(rate - interval.low, interval.high - rate)


def _correlation(counts: PairCounts) -> float:
    """Return the correlation of paired outcomes, drawn towards 0 if it is positive; 0 if one never varies."""
    n_first, n_second = counts.both + counts.only_first, counts.both + counts.only_second
    n = counts.n_pairs
    product = n_first * (n - n_first) * n_second * (n - n_second)
    if product == 0:
        return 0.0
    determinant: float = counts.both * counts.neither - counts.only_first * counts.only_second
    if determinant > 0:
        determinant = max(determinant - n / 2, 0)
    return determinant / math.sqrt(product)


def p_above(n_success: int, n_episodes: int, rate: float) -> float:
    """Return the probability of at least so many successes if the true rate is `rate`; 1 without an episode.

    Source: one-sided exact binomial test, computed by scipy.stats.binomtest.
    """
    if n_episodes == 0:
        return 1.0
    return float(scipy.stats.binomtest(n_success, n_episodes, rate, alternative="greater").pvalue)


def p_more(first: tuple[int, int], second: tuple[int, int]) -> float:
    """Return the probability that the first is at least this far ahead if both are equally good.

    Each is successes and episodes; the episodes are not the same.

    Source: Fisher's one-sided exact test, computed by scipy.stats.fisher_exact.
    """
    table = [[n_success, n_episodes - n_success] for n_success, n_episodes in (first, second)]
    return float(scipy.stats.fisher_exact(table, alternative="greater").pvalue)


def holm(p_values: Sequence[float]) -> tuple[float, ...]:
    """Return the p values of all comparisons reported together, corrected, in the same order.

    Source: Holm 1979, Scandinavian Journal of Statistics 6(2):65-70: keeps the probability of any false
    positive among them below the level, whatever their dependence. Computed by statsmodels.
    """
    if len(p_values) < 2:
        return tuple(p_values)
    # Not at the top: it imports pandas, which a report without comparisons does not need.
    from statsmodels.stats.multitest import multipletests

    return tuple(float(p) for p in multipletests(p_values, method="holm")[1])


def chance_corrected(score: float | None, *, chance: float | None, ceiling: float | None) -> float | None:
    """Return a success rate relative to chance (0) and the oracle's (1); below chance it is negative.

    None if a value is missing or the ceiling is not above chance.

    Source: the form of Cohen's kappa (1960, Educational and Psychological Measurement 20:37-46), with
    the measured ceiling instead of 1.
    """
    if score is None or chance is None or ceiling is None or ceiling <= chance:
        return None
    return (score - chance) / (ceiling - chance)
