"""What came of the choice: each cause, and the test for habits against numbers worked out by hand."""

from typing import Any

import pytest

from vla_eval.records import EpisodeRecord
from vla_eval.results.choice_causes import find_habit, report_choices
from vla_eval.results.grouping import RowEpisodes, RowKey, Run

KEY = RowKey("RememberColor3-v0", "p", 1, None)


def group(*episodes: dict[str, Any]) -> RowEpisodes:
    records = {seed: _record(seed, **values) for seed, values in enumerate(episodes)}
    return RowEpisodes(key=KEY, runs=(Run(index=0, copy=0, records=records),))


def _record(seed: int, *, target: int, chosen: int | None, **values: Any) -> EpisodeRecord:
    won = values.pop("won", chosen == target)
    own: dict[str, Any] = {
        "n_candidates": 3,
        "tcp_reach_m": 0.3,
        "target_place": target,
        "first_choice_place": chosen,
        **values,
    }
    return EpisodeRecord(
        task=KEY.task,
        policy="p",
        n_action_steps=1,
        run=0,
        seed=seed,
        outcome="success" if won else "failure",
        success_once=won,
        target=target,
        first_choice=chosen,
        first_choice_success=chosen == target,
        **own,
    )


def test_each_episode_has_one_cause() -> None:
    report = report_choices(
        group(
            {"target": 0, "chosen": 0},
            {"target": 0, "chosen": 0, "won": False},
            {"target": 0, "chosen": 1},
            {"target": 0, "chosen": None},
            {"target": 0, "chosen": None, "tcp_reach_m": 0.01},
        )
    )
    assert report is not None
    assert report.causes == {
        **{"right": 1, "not_finished": 1, "wrong": 1, "position_habit": 0},
        **{"never_chose": 1, "could_not_move": 1},
    }


def test_an_arm_whose_reach_was_not_recorded_is_not_said_to_stand_still() -> None:
    report = report_choices(group({"target": 0, "chosen": None, "tcp_reach_m": None}))
    assert report is not None
    assert (report.causes["could_not_move"], report.causes["never_chose"]) == (0, 1)
    assert not report.reach_is_known


def test_wrong_choices_that_always_go_to_one_place_are_a_habit_and_not_forgetting() -> None:
    # Place 2 whatever the target: of 10 wrong choices 10 went there, by luck 1 in 2.
    # One-sided p = 2^-10, times 3 places: 0.0029.
    episodes = [{"target": index % 2, "chosen": 2} for index in range(10)]
    report = report_choices(group(*episodes, {"target": 0, "chosen": None}))
    assert report is not None
    habit = report.habits["place"]
    assert habit is not None
    assert (habit.index, habit.n_chosen, habit.n_possible, habit.by_luck) == (2, 10, 10, 0.5)
    assert habit.p_value == pytest.approx(3 / 2**10)
    assert (report.causes["position_habit"], report.causes["wrong"]) == (10, 0)


def test_a_policy_that_remembers_has_no_habit_even_if_the_target_is_always_at_one_place() -> None:
    report = report_choices(group(*({"target": 1, "chosen": 1} for _ in range(20))))
    assert report is not None
    assert report.habits["place"] is None
    assert report.causes["right"] == 20


def test_even_guessing_is_forgetting_and_no_habit() -> None:
    # Each of the six wrong pairs once: each index was chosen in 2 of the 4 episodes in which it was wrong.
    pairs = [(t, c) for t in range(3) for c in range(3) if t != c]
    report = report_choices(group(*({"target": t, "chosen": c} for t, c in pairs)))
    assert report is not None
    habit = report.habits["place"]
    assert habit is not None and habit.p_value == 1.0  # 3 x P(at least 2 of 4) = 3 x 11/16, at most 1
    assert report.causes["wrong"] == 6


def test_with_two_candidates_a_wrong_choice_says_nothing_of_habits() -> None:
    assert find_habit({(0, 1): 50}, 2) is None


def test_the_confusion_counts_episodes_by_target_and_choice() -> None:
    report = report_choices(
        group({"target": 0, "chosen": 1}, {"target": 0, "chosen": 1}, {"target": 2, "chosen": None})
    )
    assert report is not None
    assert report.confusion["item"] == {(0, 1): 2, (2, None): 1}


def test_places_that_were_not_recorded_give_no_matrix() -> None:
    report = report_choices(
        group({"target": 0, "chosen": 1, "target_place": None, "first_choice_place": None})
    )
    assert report is not None
    assert not report.confusion["place"]
    assert report.habits["place"] is None


def test_a_task_without_candidates_has_no_report() -> None:
    assert report_choices(group({"target": 0, "chosen": None, "n_candidates": None})) is None
