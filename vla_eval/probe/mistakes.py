"""How many items a policy keeps, and what its mistakes are, from the sequence of its touches.

Pure functions of records. Records of earlier versions lack the touches: then all of it is undefined (None).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from vla_eval.probe.retention import BOOTSTRAP_SEED, N_DRAWS, quantiles
from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import Interval
from vla_eval.tasks.spec import TaskSpec

MistakeKind = Literal["order", "place", "identity"]
MISTAKES: tuple[MistakeKind, ...] = get_args(MistakeKind)
TOLERANCE = 1e-6  # of an item, of the search for the number of items kept


class _Touches(NamedTuple):
    """What was right and what was touched, up to as many as are right; places by candidate."""

    right: tuple[int, ...]
    touched: tuple[int, ...]
    places: tuple[int, ...]
    n_candidates: int


class _Mistake(NamedTuple):
    """The first mistake of an episode, and the probability that a wrong item lies next to a due one."""

    kind: MistakeKind
    chance_of_place: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Mistakes:
    """The first mistakes of the episodes of one world."""

    n_episodes: int  # episodes whose touches are known
    # by kind. `order`: an item that was shown, but out of turn; `place`: one that was not shown, at a
    # place next to that of one that was due; `identity`: another one that was not shown.
    counts: Mapping[MistakeKind, int]
    # so many of the last two kinds would be next to a due item if the wrong items were drawn at random;
    # None where the items are places themselves
    expected_place: float | None
    n_incomplete: int  # no mistake, but fewer touches than are right

    @property
    def n_mistakes(self) -> int:
        """The number of episodes with a mistake."""
        return sum(self.counts.values())


class Capacity(NamedTuple):
    """How many of the items shown are kept, on average, with its interval at 95 %."""

    n_items: float
    interval: Interval


def mistakes(records: Sequence[EpisodeRecord], spec: TaskSpec) -> Mistakes | None:
    """Return the first mistakes; None if no touches are known."""
    known = [found for record in records if (found := _touches(record)) is not None]
    if not known:
        return None
    first = [_first_mistake(episode, spec) for episode in known]
    kinds = [one.kind for one in first if one is not None]
    chances = [one.chance_of_place for one in first if one is not None and one.kind != "order"]
    return Mistakes(
        n_episodes=len(known),
        counts={kind: kinds.count(kind) for kind in MISTAKES},
        expected_place=None if spec.cue_marks_place else sum(chance or 0.0 for chance in chances),
        n_incomplete=sum(
            one is None and len(episode.touched) < len(episode.right)
            for one, episode in zip(first, known, strict=True)
        ),
    )


def capacity(records: Sequence[EpisodeRecord]) -> Capacity | None:
    """Return how many items are kept (docs/probe.md) and the bootstrap's interval, if they are known."""
    known = [found for record in records if (found := _touches(record)) is not None]
    if not known or any(not 1 < len(one.right) < one.n_candidates for one in known):
        return None
    if len({(len(one.right), one.n_candidates) for one in known}) != 1:
        return None
    n_shown, n_candidates = len(known[0].right), known[0].n_candidates
    n_touches = np.array([len(one.touched) for one in known])
    n_right = np.array([len(set(one.touched) & set(one.right)) for one in known])
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    chosen_DE = np.stack([rng.integers(len(known), size=len(known)) for _ in range(N_DRAWS)])
    # At once: one after the other they took a second for each row of a table.
    drawn = _kept(n_touches[chosen_DE], n_right[chosen_DE].mean(axis=1), n_shown, n_candidates)
    (kept,) = _kept(n_touches[None], n_right.mean(keepdims=True), n_shown, n_candidates)
    return Capacity(float(kept), Interval(*quantiles(drawn.tolist())))


def _kept(
    n_touches_DE: NDArray[np.int64], means_D: NDArray[np.float64], shown: int, n: int
) -> NDArray[np.float64]:
    """Return the k at which the expected right touches (D draws, E episodes) are the mean."""

    def expected(kept_D: NDArray[np.float64]) -> NDArray[np.float64]:
        kept_D1 = kept_D[:, None]
        guessed_DE = np.maximum(n_touches_DE - kept_D1, 0) * (shown - kept_D1) / (n - kept_D1)
        means: NDArray[np.float64] = (np.minimum(n_touches_DE, kept_D1) + guessed_DE).mean(axis=1)
        return means

    low_D, high_D = np.zeros_like(means_D), np.full_like(means_D, shown)
    is_guessed_D = means_D <= expected(low_D)
    while high_D[0] - low_D[0] > TOLERANCE:  # all have the same width
        middle_D = (low_D + high_D) / 2
        is_below_D = expected(middle_D) < means_D
        low_D, high_D = np.where(is_below_D, middle_D, low_D), np.where(is_below_D, high_D, middle_D)
    return np.where(is_guessed_D, 0.0, (low_D + high_D) / 2)


def _touches(record: EpisodeRecord) -> _Touches | None:
    parts = (record.right_candidates, record.touched_candidates, record.candidate_places)
    if record.outcome == "error" or record.n_candidates is None or not parts[0]:
        return None
    right, touched, places = parts
    if right is None or touched is None or places is None:
        return None
    return _Touches(right, touched[: len(right)], places, record.n_candidates)


def _first_mistake(episode: _Touches, spec: TaskSpec) -> _Mistake | None:
    for index, touched in enumerate(episode.touched):
        earlier = episode.touched[:index]
        due = [episode.right[index]] if spec.order_counts else [i for i in episode.right if i not in earlier]
        if touched in episode.right:
            if spec.order_counts and touched != due[0]:
                return _Mistake("order", None)
            continue
        if spec.cue_marks_place:
            return _Mistake("place", None)
        wrong = [i for i in range(episode.n_candidates) if i not in episode.right]
        places = episode.places
        beside = [i for i in wrong if any(abs(places[i] - places[other]) == 1 for other in due)]
        return _Mistake("place" if touched in beside else "identity", len(beside) / len(wrong))
    return None
