"""Is a policy as good as was claimed? A test that may stop after any episode. Pure functions of numbers.

A claim is k of n, so the rate behind it is known within its exact interval (Clopper and Pearson 1934). Half
of the level goes into that, half into the new episodes: for each of two hypotheses about their rate, a
mixture of likelihood ratios (Robbins 1970, Annals of Mathematical Statistics 41(5)), which is an e-process.
By Ville's inequality it exceeds 1/a at any time with probability a at most, so looking after each episode
costs nothing.
"""

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from vla_eval.errors import RecipeError
from vla_eval.strict.bounds import require

Verdict = Literal["reproduced", "below", "open"]
SMALLEST_P = 1e-9  # below, a p-value is not computed
Numbers = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """So many successes in so many episodes."""

    n_success: int
    n_episodes: int

    def __post_init__(self) -> None:
        require(self.n_episodes >= 1, "n_episodes", self.n_episodes, "at least 1")
        require(0 <= self.n_success <= self.n_episodes, "n_success", self.n_success, "0 to n_episodes")

    @property
    def rate(self) -> float:
        """The share of successes."""
        return self.n_success / self.n_episodes

    def bounds(self, level: float) -> tuple[float, float]:
        """Return the exact bounds of the rate behind the claim, each of which fails with this probability."""
        return _exact_bounds(self.n_success, self.n_episodes, level)

    def __str__(self) -> str:
        """Return `91 of 100 (0.91)`."""
        return f"{self.n_success} of {self.n_episodes} ({self.rate:.2f})"


@functools.lru_cache(maxsize=256)  # a plan asks for the same ones at each number of episodes
def _exact_bounds(k: int, n: int, level: float) -> tuple[float, float]:
    low = float(stats.beta.ppf(level, k, n - k + 1)) if k else 0.0
    high = float(stats.beta.isf(level, k + 1, n - k)) if k < n else 1.0
    return low, high


@dataclass(frozen=True, slots=True, kw_only=True)
class Acceptance:
    """The test of a claim: which loss matters, and how often each verdict may be wrong.

    *Below* is said of a policy as good as claimed, and *reproduced* of one that has lost `loss` or more, each
    with probability `level` at most, over the claim's episodes and the new ones.
    """

    claim: Claim
    loss: float = 0.1  # of the success rate
    level: float = 0.05

    def __post_init__(self) -> None:
        require(0 < self.loss < 1, "loss", self.loss, "a number between 0 and 1")
        require(SMALLEST_P < self.level < 0.5, "level", self.level, "a number between 0 and 0.5")

    @property
    def floor(self) -> float:
        """The rate below which a policy is worse than claimed."""
        return self.claim.bounds(self.level / 2)[0]

    @property
    def bar(self) -> float:
        """The rate above which a policy has lost less than `loss`."""
        return self.claim.bounds(self.level / 2)[1] - self.loss

    def check(self) -> None:
        """Raise `RecipeError` if no number of episodes could show that the claim is reproduced."""
        if self.bar <= 0:
            raise RecipeError(
                f"loss: the claim is {self.claim}, so a policy that never succeeds may have lost less than "
                f"{self.loss:g}. Use a smaller loss."
            )
        if self.bar >= self.claim.rate:
            least = self.bar + self.loss - self.claim.rate
            raise RecipeError(
                f"loss: the claim is {self.claim}, so the rate behind it may be as high as "
                f"{self.bar + self.loss:.2f}, and no number of episodes shows that less than {self.loss:g} "
                f"was lost. Use a loss above {math.ceil(least * 100) / 100:g}, or a claim of more episodes."
            )


class Decision(NamedTuple):
    """What the episodes say: the verdict, and of how many episodes it is, of which so many succeeded."""

    verdict: Verdict
    n_episodes: int
    n_success: int
    # the smallest level at which *below* would have been said; None for the other verdicts
    p_value: float | None = None


class Power(NamedTuple):
    """The probabilities of both verdicts by the number of episodes; (N,), the first is of one episode."""

    reproduced: Numbers
    below: Numbers


def decide(test: Acceptance, outcomes: Sequence[bool]) -> Decision:
    """Return the verdict of the first episode after which there is one.

    Args:
        test: the test.
        outcomes: whether each episode succeeded, in an order that was fixed before, such as by seed.
    """
    successes = np.cumsum(np.array(outcomes, dtype=np.int64))
    episodes = np.arange(1, len(outcomes) + 1)
    worse, better = _shown(test, successes, episodes)
    decided = np.flatnonzero(worse | better)
    if not len(decided):
        return Decision("open", len(outcomes), int(successes[-1]) if len(outcomes) else 0)
    at = int(decided[0])
    n, k = at + 1, int(successes[at])
    if not worse[at]:
        return Decision("reproduced", n, k)
    return Decision("below", n, k, _p_value(test, successes[:n], episodes[:n]))


def power(test: Acceptance, rate: float, n_episodes: int) -> Power:
    """Return how probable each verdict is by each number of episodes, for a policy of this rate: exact."""
    found = np.array(list(itertools.islice(_probabilities(test, rate), n_episodes)))
    return Power(found[:, 0], found[:, 1])


def plan(test: Acceptance, *, wanted_power: float, most: int) -> int:
    """Return the fewest episodes that accept a policy as good as claimed with this probability.

    Raises:
        RecipeError: it takes more than `most`.
    """
    test.check()
    reproduced = 0.0
    by_number = itertools.islice(_probabilities(test, test.claim.rate), most)
    for n, (reproduced, _) in enumerate(by_number, start=1):
        if reproduced >= wanted_power:
            return n
    raise RecipeError(
        f"The claim is {test.claim}: in {most} episodes, a policy as good is accepted with probability "
        f"{reproduced:.2f}, and {wanted_power:g} was asked for. Allow more --episodes, a larger --loss or a "
        "lower --power."
    )


def _probabilities(test: Acceptance, rate: float) -> Iterator[tuple[float, float]]:
    """Yield for 1, 2 … episodes how probable *reproduced* and *below* are by then."""
    reproduced = below = 0.0
    undecided = np.array([1.0])  # by the number of successes so far
    for n in itertools.count(1):
        undecided = np.append(undecided, 0.0) * (1 - rate) + np.append(0.0, undecided) * rate
        counts, of = np.arange(n + 1), np.full(n + 1, n)
        worse, better = _shown(test, counts, of)
        below += float(undecided[worse].sum())
        reproduced += float(undecided[better].sum())
        undecided = np.where(worse | better, 0.0, undecided)
        yield reproduced, below


def fixed_plan(test: Acceptance, *, wanted_power: float, most: int) -> int | None:
    """Return the same for a test that looks once, at the end (exact binomial); None if it is above `most`."""
    for n in range(1, most + 1):
        least = int(stats.binom.isf(test.level / 2, n, test.bar)) + 1  # successes that are shown to be above
        if stats.binom.sf(least - 1, n, test.claim.rate) >= wanted_power:
            return n
    return None


def _p_value(test: Acceptance, successes: NDArray[np.int64], episodes: NDArray[np.int64]) -> float:
    low, high = math.log(SMALLEST_P), math.log(test.level)
    for _ in range(40):  # a bisection to 1e-11 of the width
        level = math.exp((low + high) / 2)
        floor = test.claim.bounds(level / 2)[0]
        if _is_shown(_log_below(successes, episodes, floor), level).any():
            high = math.log(level)
        else:
            low = math.log(level)
    return math.exp(high)


def _shown(
    test: Acceptance, successes: NDArray[np.int64], episodes: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where *below* is shown, and where *reproduced* is and not *below*."""
    worse = _is_shown(_log_below(successes, episodes, test.floor), test.level)
    return worse, _is_shown(_log_above(successes, episodes, test.bar), test.level) & ~worse


def _is_shown(log_e: Numbers, level: float) -> NDArray[np.bool_]:
    shown: NDArray[np.bool_] = log_e >= math.log(2 / level)
    return shown


def _log_above(successes: NDArray[np.int64], episodes: NDArray[np.int64], rate: float) -> Numbers:
    """Return the evidence that the rate is above: likelihood ratios, averaged over all rates above."""
    k, n = successes.astype(np.float64), episodes.astype(np.float64)
    return _log_mean(k, n, special.betaincc(k + 1, n - k + 1, rate), width=1 - rate, rate=rate)


def _log_below(successes: NDArray[np.int64], episodes: NDArray[np.int64], rate: float) -> Numbers:
    """Return the evidence that the rate is below: likelihood ratios, averaged over all rates below."""
    if rate <= 0:
        return np.full(len(successes), -np.inf)
    k, n = successes.astype(np.float64), episodes.astype(np.float64)
    return _log_mean(k, n, special.betainc(k + 1, n - k + 1, rate), width=rate, rate=rate)


def _log_mean(k: Numbers, n: Numbers, share: Numbers, *, width: float, rate: float) -> Numbers:
    """Return log of the integral of q^k (1 - q)^(n - k) over a share of [0, 1], over width and likelihood."""
    with np.errstate(divide="ignore"):
        area = special.betaln(k + 1, n - k + 1) + np.log(share) - math.log(width)
    return np.asarray(area - special.xlogy(k, rate) - special.xlog1py(n - k, -rate), dtype=np.float64)
