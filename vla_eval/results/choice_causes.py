"""Outcomes of the choice in a row's episodes; `docs/report_page.md` explains each cause."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import LEVEL, p_above
from vla_eval.results.grouping import RowEpisodes

Cause = Literal["right", "not_finished", "wrong", "position_habit", "never_chose", "could_not_move"]
CAUSES: tuple[Cause, ...] = get_args(Cause)
Kind = Literal["item", "place"]

MOVED_M = 0.05  # half the distance between two neighbouring places: below it, the arm went to none of them


@dataclass(frozen=True, slots=True, kw_only=True)
class Habit:
    """Wrong choices that go to one place (or item) more often than expected by chance."""

    index: int  # the place or item with the smallest p value among the wrong choices
    n_chosen: int  # number of wrong choices that went to it
    # number of wrong choices that could go to it: those of episodes in which it was wrong
    n_possible: int
    by_luck: float  # the share that would go to it if all wrong ones were equally likely: 1/(N - 1)
    p_value: float  # one-sided exact binomial test, times N because N were tested (Bonferroni)

    @property
    def is_found(self) -> bool:
        """Whether it is significant at 5 %."""
        return self.p_value < LEVEL


@dataclass(frozen=True, slots=True, kw_only=True)
class ChoiceReport:
    """The choices of a row's episodes with candidates."""

    n_candidates: int
    candidate_names: tuple[str, ...] | None  # where records have them
    causes: Mapping[Cause, int]  # cause -> number of episodes; contains every cause
    # by item and by place: (target, chosen or None) -> number of episodes. Empty if it was not recorded,
    # or if several candidates are right.
    confusion: Mapping[Kind, Mapping[tuple[int, int | None], int]]
    # by item and by place; None if there is nothing to test: fewer than three candidates, no wrong
    # choice, or nothing recorded
    habits: Mapping[Kind, Habit | None]
    # whether the records say how far the arm moved; otherwise no episode counts as `could_not_move`
    reach_is_known: bool


def report_choices(group: RowEpisodes) -> ChoiceReport | None:
    """Sort a row's episodes by the outcome of the choice; None without a result or candidates."""
    results = [record for record in group.results if record.n_candidates]
    if not results:
        return None
    n_candidates = max(record.n_candidates or 0 for record in results)
    confusion: dict[Kind, Counter[tuple[int, int | None]]] = {
        "item": Counter((r.target, r.first_choice) for r in results if r.target is not None),
        "place": Counter(
            (r.target_place, r.first_choice_place) for r in results if r.target_place is not None
        ),
    }
    habits: dict[Kind, Habit | None] = {
        kind: find_habit(counts, n_candidates) for kind, counts in confusion.items()
    }
    causes = Counter(_cause(record, habits["place"]) for record in results)
    return ChoiceReport(
        n_candidates=n_candidates,
        candidate_names=next((one.candidate_names for one in results if one.candidate_names), None),
        causes={cause: causes[cause] for cause in CAUSES},
        confusion=confusion,
        habits=habits,
        reach_is_known=all(record.tcp_reach_m is not None for record in results),
    )


def find_habit(counts: Mapping[tuple[int, int | None], int], n_candidates: int) -> Habit | None:
    """Test whether wrong choices prefer one of three or more indices; return the one of smallest p."""
    wrong = {pair: n for pair, n in counts.items() if pair[1] is not None and pair[0] != pair[1]}
    if n_candidates < 3 or not wrong:
        return None
    by_luck = 1 / (n_candidates - 1)
    found = []
    for index in range(n_candidates):
        n_possible = sum(n for (target, _), n in wrong.items() if target != index)
        n_chosen = sum(n for (_, chosen), n in wrong.items() if chosen == index)
        if n_possible:
            p = min(1.0, p_above(n_chosen, n_possible, by_luck) * n_candidates)
            habit = Habit(index=index, n_chosen=n_chosen, n_possible=n_possible, by_luck=by_luck, p_value=p)
            found.append(habit)
    return min(found, key=lambda habit: habit.p_value)


def _cause(record: EpisodeRecord, habit: Habit | None) -> Cause:
    if record.first_choice is None:
        stayed = record.tcp_reach_m is not None and record.tcp_reach_m < MOVED_M
        return "could_not_move" if stayed else "never_chose"
    if record.first_choice_success:
        return "right" if record.success_once else "not_finished"
    is_habit = habit is not None and habit.is_found and record.first_choice_place == habit.index
    return "position_habit" if is_habit else "wrong"
