"""How long a memory lasts: following the cue as a function of the delay, and the delay that halves it.

Pure functions of episodes. The bootstrap draws whole seeds, so that the same episodes at different delays
stay together, from a generator with a constant seed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from vla_eval.results.estimates import CONFIDENCE, LEVEL, Interval, p_above, wilson_interval

N_DRAWS = 1000
BOOTSTRAP_SEED = 20260927
BEYOND = float("inf")

Followed = NDArray[np.bool_]
"""(S,) per seed and run: whether the episode follows the cue; the same order at each delay."""


class Range(NamedTuple):
    """(low, high) of an interval that may reach beyond the longest delay: `high` is None then."""

    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class HalfLife:
    """The delay at which half of what is above chance at the shortest delay is left."""

    steps: float | None  # None if more than half is left at the longest delay
    # at 95 %, by bootstrap over seeds; an end that is None lies beyond the longest delay
    interval: Range
    longest_delay: int


def half_life(followed: Mapping[int, Followed], chance: float) -> HalfLife | None:
    """Return the half-life of a memory: delay in steps -> episodes, and the rate without memory.

    docs/probe.md defines it. None with one delay, or if at the shortest one the cue is not followed more
    often than by chance (one-sided exact binomial test at 0.05): then there is nothing to halve.
    """
    delays = sorted(followed)
    if len(delays) < 2:
        return None
    episodes = np.stack([followed[delay] for delay in delays])  # (delays, seeds)
    n_episodes = episodes.shape[1]
    if n_episodes == 0 or p_above(int(episodes[0].sum()), n_episodes, chance) >= LEVEL:
        return None
    low, high = _bootstrap(
        n_episodes, lambda chosen: _halved_at(delays, episodes[:, chosen].mean(axis=1), chance)
    )
    steps = _halved_at(delays, episodes.mean(axis=1), chance)
    if low == high and steps != BEYOND:  # all draws are alike: known is only between which delays
        low = max((delay for delay in delays if delay < steps), default=delays[0])
        high = min(delay for delay in delays if delay >= steps)
    interval = Range(_known(low), _known(high))
    return HalfLife(steps=_known(steps), interval=interval, longest_delay=delays[-1])


def _halved_at(delays: Sequence[int], rates: NDArray[np.float64], chance: float) -> float:
    """Return the delay at which the curve falls to the middle between its beginning and chance."""
    fitted = scipy.optimize.isotonic_regression(rates, increasing=False).x
    middle = (float(fitted[0]) + chance) / 2
    if fitted[0] <= chance:  # of a bootstrap draw: nothing above chance, so nothing lasts
        return float(delays[0])
    below = np.flatnonzero(fitted <= middle)
    if not below.size:
        return BEYOND
    before, after = int(below[0]) - 1, int(below[0])
    share = (fitted[before] - middle) / (fitted[before] - fitted[after])
    return float(delays[before] + share * (delays[after] - delays[before]))


def share_left(before: Followed, after: Followed) -> tuple[float, Range] | None:
    """Return after / before, with its interval; None if there was nothing before.

    The interval is that of the bootstrap over seeds. Where all draws are alike, as with 12 of 12, it would
    have no width, as if there were no uncertainty. Then it is that of the least and the most that both
    Wilson intervals allow.
    """
    if not before.any():
        return None

    def left(chosen: NDArray[np.int64]) -> float:
        n_before = int(before[chosen].sum())
        return int(after[chosen].sum()) / n_before if n_before else BEYOND

    low, high = _bootstrap(len(before), left)
    if low == high:
        least_before, most_before = _wilson(before)
        least_after, most_after = _wilson(after)
        low, high = least_after / most_before, most_after / least_before
    return float(after.sum() / before.sum()), Range(_known(low), _known(high))


class Contrast(NamedTuple):
    """How much more is followed in another world than after a delay, with its interval at 95 %."""

    delay_steps: int
    difference: float
    interval: Interval


def contrast(delay_steps: int, after: Followed, other: Followed) -> Contrast:
    """Return the difference, other minus after, of the same episodes; its interval is as in `share_left`."""
    per_episode = other.astype(float) - after
    low, high = _bootstrap(len(per_episode), lambda chosen: float(per_episode[chosen].mean()))
    if low == high:
        (least_after, most_after), (least_other, most_other) = _wilson(after), _wilson(other)
        low, high = least_other - most_after, most_other - least_after
    return Contrast(delay_steps, float(per_episode.mean()), Interval(low, high))


def _bootstrap(n_episodes: int, value: Callable[[NDArray[np.int64]], float]) -> tuple[float, float]:
    """Return the interval of a value over draws of as many episodes, given by their indices."""
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    return quantiles([value(rng.integers(n_episodes, size=n_episodes)) for _ in range(N_DRAWS)])


def _wilson(followed: Followed) -> Interval:
    found = wilson_interval(int(followed.sum()), len(followed))
    assert found is not None  # there is an episode: the caller has looked
    return found


def quantiles(values: Sequence[float]) -> tuple[float, float]:
    """Return the ends of the central interval; without interpolation, as values may be infinite."""
    ordered = np.sort(np.asarray(values))
    tail = (1 - CONFIDENCE) / 2
    return (
        float(ordered[int(np.floor(tail * (len(ordered) - 1)))]),
        float(ordered[int(np.ceil((1 - tail) * (len(ordered) - 1)))]),
    )


def _known(value: float) -> float | None:
    return None if value == BEYOND else value
