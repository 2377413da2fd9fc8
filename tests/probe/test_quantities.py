"""The quantities of a probe, from episodes that were made up: each expected value is counted by hand."""

import dataclasses

import numpy as np
import pytest

from vla_eval.probe.quantities import follows, pair_up, paired_p, swap_quantities, wilson_of_rate
from vla_eval.probe.retention import Range, contrast, half_life, share_left
from vla_eval.records import EpisodeError, EpisodeRecord
from vla_eval.results.estimates import wilson_interval
from vla_eval.tasks.catalog import task_spec

COLOR = task_spec("RememberColor3-v0")


def record(seed: int, *, target: int | None = 0, choice: int | None = 0, digest: str = "a") -> EpisodeRecord:
    """An episode that chose a candidate, and succeeded if that was the right one."""
    won = choice is not None and choice == target
    return EpisodeRecord(
        task=COLOR.id,
        policy="p",
        n_action_steps=1,
        run=0,
        seed=seed,
        outcome="success" if won else "failure",
        success_once=won,
        target=target,
        n_candidates=3,
        first_choice=choice,
        first_choice_success=won,
        chance_success=1 / 3,
        trajectory_sha256=digest,
    )


def error(seed: int) -> EpisodeRecord:
    cause = EpisodeError(kind="WorkerCrashed", stage="step", message="gone")
    return EpisodeRecord(
        task=COLOR.id, policy="p", n_action_steps=1, run=0, seed=seed, outcome="error", error=cause
    )


def worlds(choices: list[tuple[int | None, int | None]]) -> list:  # type: ignore[type-arg]
    """Pairs in which 0 is right as drawn and 1 is right with the cue swapped."""
    drawn = [record(seed, target=0, choice=one) for seed, (one, _) in enumerate(choices)]
    other = [record(seed, target=1, choice=two) for seed, (_, two) in enumerate(choices)]
    return pair_up(drawn, other)


def test_a_pair_is_warranted_only_if_both_cues_are_followed() -> None:
    # Follows both; changes, but to neither; always goes to 0; the reverse of both; never chooses.
    found = swap_quantities(worlds([(0, 1), (2, 0), (0, 0), (1, 0), (None, None)]), COLOR)
    assert found is not None
    assert found.sensitivity == (3, 5)  # the first, the second, the fourth
    assert found.change_of == "choice"
    assert found.warranted_choice == (1, 5)
    assert found.reliability == (1, 5)
    assert found.matched_value == 3 / 10  # two successes as drawn, one with the cue swapped
    assert found.p_value == 1.0  # one for, one against: the toss of a coin


def test_the_sign_test_is_that_of_a_coin() -> None:
    found = swap_quantities(worlds([(0, 1)] * 10), COLOR)
    assert found is not None
    assert found.p_value == pytest.approx(2 * 0.5**10)
    constant = swap_quantities(worlds([(2, 2)] * 10), COLOR)
    assert constant is not None
    assert (constant.p_value, constant.sensitivity) == (1.0, (0, 10))


def test_errors_and_episodes_without_a_partner_are_in_no_pair() -> None:
    drawn = [record(1), error(2), record(3), record(4)]
    other = [record(4), record(1), record(2), error(3)]
    assert [pair.drawn.seed for pair in pair_up(drawn, other)] == [1, 4]
    assert swap_quantities([], COLOR) is None
    assert paired_p([]) is None


def test_without_a_single_right_candidate_following_is_success_and_change_is_of_actions() -> None:
    bunch = task_spec("BunchOfColors3-v0")
    several = dataclasses.replace(record(1, choice=4), target=None, success_once=True, outcome="success")
    assert follows(several)
    pairs = pair_up([several], [dataclasses.replace(several, trajectory_sha256="b")])
    found = swap_quantities(pairs, bunch)
    assert found is not None
    assert (found.change_of, found.sensitivity, found.p_value) == ("actions", (1, 1), None)
    chain = swap_quantities(pairs, task_spec("ChainOfColors3-v0"))
    assert chain is not None
    assert (chain.change_of, chain.sensitivity) == ("choice", (0, 1))


def test_where_the_state_holds_the_cue_a_change_of_actions_is_not_known() -> None:
    plain = dataclasses.replace(
        record(1), target=None, n_candidates=None, first_choice=None, first_choice_success=None
    )
    found = swap_quantities(pair_up([plain], [plain]), task_spec("RotateStrictPos-v0"))
    assert found is not None
    assert (found.change_of, found.sensitivity, found.actions_changed) == (None, None, None)


def test_the_interval_of_a_mean_is_wilson_s_for_whole_numbers() -> None:
    for n_success in (0, 13, 50):
        expected = wilson_interval(n_success, 50)
        assert expected is not None
        assert wilson_of_rate(n_success / 50, 50) == pytest.approx(tuple(expected))


def followed(*counts: int, of: int = 20) -> dict[int, np.ndarray]:  # type: ignore[type-arg]
    """At delays 0, 10, 20 …: so many of the episodes follow the cue."""
    return {10 * i: np.arange(of) < count for i, count in enumerate(counts)}


def test_a_half_life_lies_where_half_of_what_is_above_chance_is_left() -> None:
    # Above a chance of 0.2: 0.8, then 0.6, then 0.2. Half of 0.8 is 0.4: half way from 10 to 20.
    found = half_life(followed(100, 80, 40, of=100), chance=0.2)
    assert found is not None
    assert found.steps == pytest.approx(15)
    assert found.longest_delay == 20
    low, high = found.interval
    assert low is not None and high is not None
    assert low < 15 < high


def test_a_memory_that_lasts_has_a_half_life_beyond_the_longest_delay() -> None:
    found = half_life(followed(20, 20, 20), chance=1 / 3)
    assert found is not None
    assert found.steps is None
    assert found.interval == Range(None, None)


def test_a_half_life_is_undefined_where_nothing_is_remembered_or_only_one_delay_is_known() -> None:
    # Binomial(20, 1/3): P(X >= 10) = 0.09, not below 0.05.
    assert half_life(followed(10, 2), chance=1 / 3) is None
    assert half_life(followed(20), chance=1 / 3) is None


def test_a_curve_that_rises_by_chance_is_made_level() -> None:
    # 12 and 16 of 20 become 14 and 14: 0.7, then 0.1; the middle of 1.0 and 0 is 0.5.
    found = half_life(followed(20, 12, 16, 2), chance=0.0)
    assert found is not None
    assert found.steps == pytest.approx(20 + 10 * (0.7 - 0.5) / (0.7 - 0.1))


def test_the_share_left_is_a_ratio_of_the_same_episodes() -> None:
    before, after = np.array([True] * 8 + [False] * 2), np.array([True] * 4 + [False] * 6)
    found = share_left(before, after)
    assert found is not None
    left, interval = found
    assert left == 0.5
    assert interval.low is not None and interval.high is not None
    assert 0 < interval.low < 0.5 < interval.high <= 1
    assert share_left(~before & before, after) is None


def test_where_all_draws_are_alike_the_intervals_still_have_a_width() -> None:
    all_follow = np.ones(12, dtype=bool)
    found = share_left(all_follow, all_follow)
    low = wilson_interval(12, 12)
    assert found is not None and low is not None
    assert found == (1.0, pytest.approx((low.low, 1 / low.low)))
    none_left = share_left(all_follow, ~all_follow)
    most = wilson_interval(0, 12)
    assert none_left is not None and most is not None
    assert none_left == (0.0, pytest.approx((0.0, most.high / low.low)))
    # From 12 of 12 to 0 of 12 between delays of 10 and 20: half way by the line, anywhere by the data.
    sudden = half_life(followed(12, 12, 0, of=12), chance=0.0)
    assert sudden is not None
    assert (sudden.steps, sudden.interval) == (15.0, Range(10, 20))


def test_another_appearance_is_compared_with_the_longest_delay_on_the_same_seeds() -> None:
    after, other = np.arange(20) < 5, np.arange(20) < 18
    found = contrast(320, after, other)
    assert (found.delay_steps, found.difference) == (320, pytest.approx(13 / 20))
    assert 0 < found.interval.low < 13 / 20 < found.interval.high < 1
    # All alike: by Wilson's intervals of 0 of 20 and 20 of 20.
    none, all_of_them = np.zeros(20, dtype=bool), np.ones(20, dtype=bool)
    least, most = wilson_interval(20, 20), wilson_interval(0, 20)
    assert least is not None and most is not None
    sudden = contrast(80, none, all_of_them)
    assert sudden.difference == 1.0
    assert sudden.interval == pytest.approx((least.low - most.high, 1.0))
