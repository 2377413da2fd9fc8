"""A policy's memory, from two worlds of the same episodes. Pure functions of records.

An undefined value is None, never 0. `docs/probe.md` defines each quantity; their names are those of the
Counterfactual Memory Audit (arXiv:2609.27247), the definitions are ours. Knows nothing of files.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import scipy

from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import CONFIDENCE, Interval, PairCounts, Share, mcnemar_exact
from vla_eval.tasks.spec import TaskSpec

CUE_IN_STATE = frozenset({"vla_eval.tasks.rotate:RotateEnv"})
"""Tasks whose cue is a number of the state: the digest of a trajectory contains it."""

ChangeOf = Literal["choice", "set", "angle", "actions"]

Answer = tuple[int, ...] | frozenset[int]
"""Candidates: in their order, where it counts."""

ANGLE_TOLERANCE_RAD = 0.1
"""Of Rotate's success rule: angles nearer to each other are one answer. Those of a swap are twice as far
apart, or more."""


class Pair(NamedTuple):
    """The same episode in the world as it is drawn, and in another one."""

    drawn: EpisodeRecord
    other: EpisodeRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class SwapQuantities:
    """Quantities of pairs with swapped cues."""

    change_of: ChangeOf | None
    # pairs whose choice changes, or what else `change_of` says; None where none is known
    sensitivity: Share | None
    actions_changed: Share | None  # pairs whose trajectories differ
    warranted_choice: Share  # pairs in which the cue is followed in both worlds
    matched_value: float  # mean success over both worlds, each by its own rule, with its interval
    matched_interval: Interval
    reliability: Share  # pairs that succeed in both worlds
    p_value: float | None  # exact two-sided sign test; None where there is no single right candidate


def pair_up(drawn: Sequence[EpisodeRecord], other: Sequence[EpisodeRecord]) -> list[Pair]:
    """Return the pairs of one task, policy and K with a result in both worlds, by run and seed."""
    partner = {(r.run, r.seed): r for r in other if r.outcome != "error"}
    pairs = [
        Pair(r, partner[r.run, r.seed]) for r in drawn if r.outcome != "error" and (r.run, r.seed) in partner
    ]
    return sorted(pairs, key=lambda pair: (pair.drawn.run, pair.drawn.seed))


def follows(record: EpisodeRecord) -> bool:
    """Return whether an episode follows its cue: by its first choice, or by success if several are right."""
    if record.target is None:
        return bool(record.success_once)
    return bool(record.first_choice_success)


def right_answer(record: EpisodeRecord, spec: TaskSpec) -> Answer | None:
    """Return what is right in an episode; None where there are no candidates, or the record is too old."""
    right = record.right_candidates if record.target is None else (record.target,)
    return _as_answer(right, spec) if right else None


def given_answer(record: EpisodeRecord, spec: TaskSpec) -> Answer:
    """Return the first candidates that were chosen, as many as are right, or fewer."""
    if record.target is not None:
        return _as_answer(() if record.first_choice is None else (record.first_choice,), spec)
    return _as_answer((record.touched_candidates or ())[: len(record.right_candidates or ())], spec)


def _as_answer(candidates: Sequence[int], spec: TaskSpec) -> Answer:
    return tuple(candidates) if spec.order_counts else frozenset(candidates)


def swap_quantities(pairs: Sequence[Pair], spec: TaskSpec) -> SwapQuantities | None:
    """Return the quantities of the pairs of a swapped cue; None without a pair."""
    if not pairs:
        return None
    moved = _share(pairs, lambda pair: pair.drawn.trajectory_sha256 != pair.other.trajectory_sha256)
    change_of = _change_of(pairs, spec)
    by_change: dict[ChangeOf | None, Share | None] = {
        "choice": _share(pairs, lambda pair: pair.drawn.first_choice != pair.other.first_choice),
        "set": _share(pairs, lambda pair: given_answer(pair.drawn, spec) != given_answer(pair.other, spec)),
        "angle": _share(pairs, _turns_differently) if change_of == "angle" else None,
        "actions": moved,
        None: None,
    }
    value = sum(bool(one.success_once) + bool(two.success_once) for one, two in pairs) / (2 * len(pairs))
    return SwapQuantities(
        change_of=change_of,
        sensitivity=by_change[change_of],
        actions_changed=None if spec.entry_point in CUE_IN_STATE else moved,
        warranted_choice=_share(pairs, lambda pair: follows(pair.drawn) and follows(pair.other)),
        matched_value=value,
        matched_interval=wilson_of_rate(value, len(pairs)),
        reliability=_share(pairs, lambda pair: bool(pair.drawn.success_once and pair.other.success_once)),
        p_value=_sign_test(pairs),
    )


def _change_of(pairs: Sequence[Pair], spec: TaskSpec) -> ChangeOf | None:
    """Return what a change is counted by, as far as the records know it."""
    is_determined = pairs[0].drawn.target is not None or spec.order_counts
    if pairs[0].drawn.n_candidates and is_determined:
        return "choice"
    records = [record for pair in pairs for record in pair]
    if all(record.touched_candidates is not None and record.right_candidates for record in records):
        return "set"
    if all(record.final_turn_rad is not None for record in records):
        return "angle"
    return None if spec.entry_point in CUE_IN_STATE else "actions"


def _share(pairs: Sequence[Pair], holds: Callable[[Pair], bool]) -> Share:
    return Share(sum(holds(pair) for pair in pairs), len(pairs))


def _turns_differently(pair: Pair) -> bool:
    one, other = pair.drawn.final_turn_rad, pair.other.final_turn_rad
    assert one is not None and other is not None  # `_change_of` has looked
    apart = abs(one - other) % math.tau
    return min(apart, math.tau - apart) > ANGLE_TOLERANCE_RAD


def _sign_test(pairs: Sequence[Pair]) -> float | None:
    """Return p of the hypothesis that the choice does not depend on the cue.

    If it did not, a pair that follows both cues would be as probable as one that chooses each world's
    candidate in the other world: the two worlds of a pair could be exchanged. Source: Fisher's sign test.
    """
    if any(pair.drawn.target is None for pair in pairs):
        return None
    n_follow = sum(follows(pair.drawn) and follows(pair.other) for pair in pairs)
    n_against = sum(
        pair.drawn.first_choice == pair.other.target and pair.other.first_choice == pair.drawn.target
        for pair in pairs
    )
    n_told = n_follow + n_against
    return min(1.0, float(scipy.stats.binomtest(n_follow, n_told).pvalue)) if n_told else 1.0


def paired_p(pairs: Sequence[Pair]) -> float | None:
    """Return p of the exact McNemar test on whether episodes follow the cue; None without a pair."""
    test = mcnemar_exact(PairCounts.of((follows(pair.drawn), follows(pair.other)) for pair in pairs))
    return None if test is None else test.p_value


def wilson_of_rate(rate: float, n: int) -> Interval:
    """Return the Wilson score interval of a mean of values in [0, 1].

    Of such means, those of zeros and ones vary most, so the interval is conservative. Source: as
    `wilson_interval`, which takes whole numbers of successes.
    """
    z = float(scipy.stats.norm.ppf((1 + CONFIDENCE) / 2))
    middle = rate + z * z / (2 * n)
    half = z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return Interval(max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale))
