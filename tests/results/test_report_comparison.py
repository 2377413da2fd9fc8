"""The success table beside its baseline, chance and ceiling, and what is said of an incomplete run."""

import pytest

from tests.results.stored_runs import (
    COLOR,
    INTERCEPT,
    cells_of,
    episode,
    episodes,
    has_note,
    only_row,
    stored,
)
from vla_eval.errors import UnknownNameError
from vla_eval.results.report import build_table, render

# ------------------------------------------------------------------------------- comparison


def test_policies_are_compared_on_the_same_episodes() -> None:
    # p wins 7 pairs, random 1, 2 are equal: difference 6/10, p = 2 (1 + 8) / 2^8 = 0.0703125.
    table = build_table([stored(episodes("p", "+++++++-+-"), episodes("random", "-------++-"))])
    row = only_row(table, "p")
    assert (row.baseline, row.n_pairs) == ("random", 10)
    assert row.paired_difference == pytest.approx(0.6)
    assert row.paired_p_raw == row.paired_p == pytest.approx(0.0703125)
    assert "+0.60 (p=0.070)" in render(table, "markdown")


def test_only_shared_seeds_are_compared() -> None:
    # Seed 1 failed to run for p, seed 4 was not run for random: seeds 2 and 3 are left.
    table = build_table([stored(episodes("p", "e+++"), episodes("random", "---"))])
    row = only_row(table, "p")
    assert (row.n_pairs, row.paired_difference) == (2, 1.0)


def test_runs_are_compared_with_the_same_run() -> None:
    # On run 0 p wins, on run 1 random wins; crossing the runs would find no difference in some pairs.
    table = build_table(
        [
            stored(
                *(episodes("p", "++"), episodes("random", "--")),
                *(episodes("p", "--", run=1), episodes("random", "++", run=1)),
            )
        ]
    )
    row = only_row(table, "p")
    assert (row.n_pairs, row.paired_difference, row.paired_p_raw) == (4, 0.0, 1.0)
    assert has_note(table, "p treats pairs of several runs as independent")


def test_a_pair_of_deterministic_policies_is_one_observation_however_often_it_is_run() -> None:
    groups = [
        [episode(policy, seed, letter, run=run, trajectory_sha256=f"{policy} {seed}") for seed in range(5)]
        for policy, letter in (("oracle", "+"), ("hold", "-"))
        for run in range(3)
    ]
    row = only_row(build_table([stored(*groups)], baseline="hold"), "oracle")
    assert row.n_pairs == 5
    assert row.paired_p_raw == pytest.approx(2 / 2**5)


def test_p_values_are_corrected_for_their_number() -> None:
    # p and q both win all 6 pairs: raw p = 2/2^6 = 0.03125 each; Holm over two: 0.0625 each.
    table = build_table([stored(episodes("p", "+" * 6), episodes("q", "+" * 6), episodes("random", "-" * 6))])
    row = only_row(table, "p")
    assert row.paired_p_raw == pytest.approx(0.03125)
    assert row.paired_p == pytest.approx(0.0625)
    assert table.n_comparisons == 2
    assert has_note(table, "Holm-corrected over 2 comparisons")


def test_the_baseline_may_be_run_at_another_n_action_steps_only_and_that_is_said() -> None:
    table = build_table([stored(episodes("p", "++", n_action_steps=4), episodes("random", "--"))])
    row = only_row(table, "p")
    assert (row.paired_difference, row.baseline_n_action_steps) == (1.0, 1)
    assert has_note(table, "random at another n_action_steps: p on RememberColor3-v0 K=4 against K=1")


def test_the_baseline_at_the_same_n_action_steps_is_preferred() -> None:
    groups = (
        episodes("p", "++", n_action_steps=4),
        episodes("random", "--"),
        episodes("random", "++", n_action_steps=4),
    )
    assert only_row(build_table([stored(*groups)]), "p").paired_difference == 0.0


def test_variants_are_not_compared_with_each_other() -> None:
    table = build_table(
        [stored(episodes("p", "++"), stop_at_success=True), stored(episodes("random", "--"), path="runs/b")]
    )
    assert only_row(table, "p").paired_difference is None


def test_a_baseline_that_was_asked_for_must_be_there() -> None:
    with pytest.raises(
        UnknownNameError, match=r"--baseline: there is no policy 'ramdom'\. Did you mean 'random'"
    ):
        build_table([stored(episodes("p", "+"), episodes("random", "-"))], baseline="ramdom")


def test_by_default_policies_are_compared_with_the_arm_that_forgets_and_beside_it_with_random() -> None:
    # Six pairs each. p wins all against random, 4 of 6 against cue_blind and loses none.
    groups = episodes("p", "++++++"), episodes("cue_blind", "++----"), episodes("random", "------")
    table = build_table([stored(*groups)])
    p, blind, random = (only_row(table, name) for name in ("p", "cue_blind", "random"))
    assert table.baselines == ("cue_blind", "random")
    assert (p.baseline, p.second_baseline) == ("cue_blind", "random")
    assert p.paired_difference == pytest.approx(4 / 6) and p.second_difference == 1
    assert (p.paired_p_raw, p.second_p_raw) == (pytest.approx(2 / 2**4), pytest.approx(2 / 2**6))
    # The two baselines are one more comparison, not two: three in all. Holm: 3 · 2/64, then 2 · 2/16.
    assert table.n_comparisons == 3
    assert (p.second_p, p.paired_p) == (pytest.approx(3 * 2 / 64), pytest.approx(2 * 2 / 16))
    assert blind.baseline is None and blind.second_difference == pytest.approx(2 / 6)
    assert random.paired_difference is random.second_difference is None
    assert has_note(table, "vs cue_blind, vs random: difference", "over 3 comparisons")


def test_a_baseline_that_is_named_is_the_only_one() -> None:
    groups = episodes("p", "++++++"), episodes("cue_blind", "++----"), episodes("random", "------")
    table = build_table([stored(*groups)], baseline="random")
    row = only_row(table, "p")
    assert (table.baselines, row.baseline, row.second_baseline) == (("random",), "random", None)
    assert "cue_blind" not in render(table, "markdown").splitlines()[2]


def test_without_a_baseline_no_column_is_empty() -> None:
    text = render(build_table([stored(episodes("p", "+-"), episodes("q", "--"))]), "markdown")
    assert "vs " not in text


def test_without_random_there_is_no_comparison_and_no_complaint() -> None:
    table = build_table([stored(episodes("p", "+"))])
    (row,) = cells_of(table)
    assert table.baselines == () and row.baseline is None
    assert row.paired_difference is None


# ------------------------------------------------------------------------------- chance and ceiling


def test_chance_is_the_cue_blind_arm_where_it_was_run() -> None:
    # p 0.75, cue_blind 0.25, oracle 1.00 of 4: corrected (0.75 - 0.25) / (1 - 0.25) = 2/3.
    groups = (episodes("p", "+++-"), episodes("cue_blind", "+---"), episodes("oracle", "++++"))
    row = only_row(build_table([stored(*groups)]), "p")
    assert (row.chance, row.chance_source, row.ceiling) == (0.25, "cue_blind", 1.0)
    assert row.chance_corrected == pytest.approx(2 / 3)


def test_chance_and_ceiling_are_those_of_the_same_n_action_steps() -> None:
    groups = (episodes("p", "+-", n_action_steps=4), episodes("cue_blind", "--"), episodes("oracle", "++"))
    row = only_row(build_table([stored(*groups)]), "p")
    assert (row.chance, row.chance_source) == (pytest.approx(1 / 3), "1/N")
    assert (row.ceiling, row.chance_corrected) == (None, None)


def test_chance_follows_the_number_of_candidates_that_the_episodes_had() -> None:
    row = only_row(build_table([stored(episodes("p", "+-", n_candidates=5))]), "p")
    assert (row.chance, row.chance_source) == (0.2, "1/N")


def test_chance_is_not_guessed_where_there_is_nothing_to_choose_from() -> None:
    records = episodes("p", "+-", task=INTERCEPT, n_candidates=None, first_choice_success=None)
    table = build_table([stored(records)])
    (row,) = cells_of(table)
    assert (row.chance, row.chance_source) == (None, None)
    assert has_note(table, "chance is unknown for InterceptMedium-v0 K=1", "run `cue_blind`")


def test_a_chance_of_few_episodes_is_called_imprecise() -> None:
    # One failure: the interval of the blind arm is [0, 0.79]; 7 of 20: [0.18, 0.57].
    policy = episodes("p", "+" * 20)
    assert has_note(build_table([stored(policy, episodes("cue_blind", "-"))]), "is imprecise", "[0.00, 0.79]")
    settled = build_table([stored(policy, episodes("cue_blind", "+" * 7 + "-" * 13))])
    assert not has_note(settled, "is imprecise")


def test_a_ceiling_at_chance_leaves_no_room_for_a_score() -> None:
    groups = (episodes("p", "+-"), episodes("cue_blind", "+-"), episodes("oracle", "+-"))
    assert only_row(build_table([stored(*groups)]), "p").chance_corrected is None


def test_a_tour_that_succeeds_takes_away_the_meaning_of_success() -> None:
    # 10 of 10: the Wilson interval begins at 10/(10 + 3.84) = 0.72, above 1/3.
    table = build_table([stored(episodes("tour", "+" * 10))])
    assert has_note(table, "RememberColor3-v0 K=1: `tour` reaches 1.00", "not by itself evidence of memory")


def test_a_tour_at_chance_is_no_reason_for_a_warning() -> None:
    # 4 of 10: the interval is [0.17, 0.69] and contains 1/3.
    assert not has_note(build_table([stored(episodes("tour", "++++------"))]), "`tour` reaches")


# ------------------------------------------------------------------------------- order, completeness


def test_rows_have_the_order_of_the_configuration() -> None:
    groups = [
        episodes(policy, "+", task=task, n_action_steps=k)
        for task in (COLOR, INTERCEPT)
        for policy in ("b", "a")
        for k in (8, 1)
    ]
    table = build_table(
        [stored(*groups, tasks=[INTERCEPT, f"vla_eval/{COLOR}"], policies=["my/a.yaml", "b"])]
    )
    assert [(row.task, row.policy, row.n_action_steps) for row in table.rows] == [
        (task, policy, k) for task in (INTERCEPT, COLOR) for policy in ("a", "b") for k in (1, 8)
    ]


def test_an_incomplete_run_is_named() -> None:
    table = build_table(
        [stored(episodes("p", "++e"), tasks=[COLOR], policies=["p", "q"], episodes=5, runs=2)]
    )
    assert has_note(table, "runs/a is incomplete", "p on RememberColor3-v0 K=1: 3 of 10", "q on", ": 0 of 10")


def test_a_complete_run_is_not_called_incomplete() -> None:
    config = {"tasks": [COLOR], "policies": ["p"], "episodes": 2, "runs": 1, "n_action_steps": [1]}
    assert not has_note(build_table([stored(episodes("p", "+e"), **config)]), "incomplete")


def test_a_checkpoint_is_known_by_the_name_its_records_carry() -> None:
    """`--policy runs/act` gives records of `act-020000`: nothing is missing."""
    config = {"tasks": [COLOR], "policies": ["runs/act"], "policy_names": ["act-020000"], "episodes": 2}
    run = stored(episodes("act-020000", "+-"), runs=1, n_action_steps=[1], **config)
    assert not has_note(build_table([run]), "incomplete")


def test_a_pair_that_was_left_out_is_not_called_incomplete() -> None:
    # A tour makes no sense on a task without candidates.
    groups = episodes("tour", "+"), episodes("p", "+"), episodes("p", "+", task=INTERCEPT, n_candidates=None)
    config = {"tasks": [COLOR, INTERCEPT], "policies": ["tour", "p"], "episodes": 1, "runs": 1}
    assert not has_note(build_table([stored(*groups, **config)]), "incomplete")
