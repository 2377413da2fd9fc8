"""Items kept and kinds of mistakes, from touches that were made up: expected values are counted by hand."""

import dataclasses
import math

import pytest

from tests.probe.test_quantities import record
from vla_eval.probe.mistakes import capacity, mistakes
from vla_eval.probe.quantities import pair_up, swap_quantities
from vla_eval.records import EpisodeRecord
from vla_eval.tasks.catalog import task_spec

CHAIN, BUNCH = task_spec("ChainOfColors3-v0"), task_spec("BunchOfColors3-v0")


def episode(*touched: int, right: tuple[int, ...] = (0, 1, 2), seed: int = 1) -> EpisodeRecord:
    """Nine candidates, of which number i lies at place i."""
    return dataclasses.replace(
        record(seed),
        target=right[0] if len(right) == 1 else None,
        n_candidates=9,
        first_choice=touched[0] if touched else None,
        right_candidates=right,
        touched_candidates=touched,
        candidate_places=tuple(range(9)),
    )


def test_a_mistake_is_of_order_place_or_identity() -> None:
    found = mistakes(
        [
            episode(0, 1, 2),
            episode(0, 2, 1),  # order: 1 was due
            episode(3, 1, 2),  # identity: 0 was due, and 1 lies beside it
            episode(0, 1, 3),  # place: 2 was due
            episode(0, 1, 2, 8),  # what is touched after all of them is no mistake
            episode(0),
            episode(),
        ],
        CHAIN,
    )
    assert found is not None
    assert found.counts == {"order": 1, "identity": 1, "place": 1} and found.n_incomplete == 2
    assert (found.n_episodes, found.n_mistakes) == (7, 3)
    # Of the six that were not shown, none lies beside 0, and one (3) beside 2.
    assert found.expected_place == pytest.approx(0 + 1 / 6)


def test_in_a_set_the_order_is_no_mistake_and_all_that_are_left_are_due() -> None:
    found = mistakes([episode(2, 0, 1), episode(2, 3, 1), episode(1, 3, 2)], BUNCH)
    assert found is not None
    # After 2, the cubes 0 and 1 are due: 3 is beside neither. In the third, 2 comes later: so it is due.
    assert (found.counts["order"], found.counts["identity"], found.counts["place"]) == (0, 1, 1)


def test_where_items_are_places_each_mistake_is_one_of_place() -> None:
    shells = task_spec("ShellGameTouch-v0")
    found = mistakes([episode(5, right=(0,)), episode(0, right=(0,))], shells)
    assert found is not None
    assert (found.counts["place"], found.counts["identity"], found.expected_place) == (1, 0, None)


def test_records_without_touches_say_nothing() -> None:
    old = [record(1), record(2)]
    assert mistakes(old, CHAIN) is None
    assert capacity(old) is None
    assert capacity([episode(0, right=(0,))]) is None  # one item: nothing to count


def test_who_touches_the_right_ones_keeps_all_and_who_touches_none_keeps_nothing() -> None:
    perfect = capacity([episode(2, 1, 0, seed=seed) for seed in range(5)])
    assert perfect is not None
    assert perfect.n_items == pytest.approx(3, abs=1e-5)
    idle = capacity([episode(seed=seed) for seed in range(5)])
    assert idle == (0.0, (0.0, 0.0))


def test_items_kept_are_corrected_for_guessing() -> None:
    # Without memory, 3 touches among 9 are right 3 * 3 / 9 = 1 time on average: nothing is kept.
    guessed = capacity([episode(0, 5, 7), episode(6, 1, 8)] * 10)
    assert guessed is not None
    assert guessed.n_items == 0.0
    # Who keeps 2 of 3 is right in 2 + 1 * 1 / 7 = 15 / 7 touches: 2 six times, 3 once.
    two = capacity([episode(0, 1, 8)] * 6 + [episode(0, 1, 2)])
    assert two is not None
    assert two.n_items == pytest.approx(2, abs=1e-4)
    assert two.interval.low < 2 < two.interval.high


def test_a_swapped_set_is_followed_if_other_items_are_touched() -> None:
    drawn, other = episode(0, 1, 2, 7), episode(2, 0, 1, 8, right=(3, 1, 2))
    found = swap_quantities(pair_up([drawn], [other]), BUNCH)
    assert found is not None
    assert (found.change_of, found.sensitivity) == ("set", (0, 1))  # the same three
    moved = dataclasses.replace(other, touched_candidates=(2, 3, 1), first_choice=2)
    found = swap_quantities(pair_up([drawn], [moved]), BUNCH)
    assert found is not None
    assert found.sensitivity == (1, 1)


@pytest.mark.parametrize(
    ("one", "other", "differs"),
    # Either side of ± π, 0.05 rad lie between these; the tolerance is 0.1 rad.
    [(0.3, 0.35, False), (0.3, 0.5, True), (math.pi - 0.02, -math.pi + 0.03, False)],
)
def test_the_sensitivity_of_rotate_is_that_of_the_final_angle(
    one: float, other: float, differs: bool
) -> None:
    plain = dataclasses.replace(
        record(1), target=None, n_candidates=None, first_choice=None, first_choice_success=None
    )
    drawn, swapped = (dataclasses.replace(plain, final_turn_rad=angle) for angle in (one, other))
    found = swap_quantities(pair_up([drawn], [swapped]), task_spec("RotateStrictPos-v0"))
    assert found is not None
    assert (found.change_of, found.sensitivity, found.actions_changed) == ("angle", (int(differs), 1), None)
