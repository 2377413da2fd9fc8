"""The success table: what is put together, what is counted, what is left undefined, and how it prints."""

import argparse
import csv
import io
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from vla_eval.cli import report as report_verb
from vla_eval.errors import ReportError, UnknownNameError
from vla_eval.results.records import EpisodeError, EpisodeRecord
from vla_eval.results.report import FORMATS, Row, Table, build_table, render
from vla_eval.results.run_file import Change
from vla_eval.results.store import RunDescription, RunFolder, Session, StoredRun

COLOR, INTERCEPT = "RememberColor3-v0", "InterceptMedium-v0"


def episodes(policy: str, outcomes: str, **changes: object) -> list[EpisodeRecord]:
    """One episode per letter, seeds from 1: `+` success, `-` failure, `e` error."""
    return [episode(policy, seed, letter, **changes) for seed, letter in enumerate(outcomes, start=1)]


def episode(policy: str, seed: int, letter: str, **changes: object) -> EpisodeRecord:
    values: dict[str, object] = {"task": COLOR, "policy": policy, "n_action_steps": 1, "run": 0, "seed": seed}
    values |= {key: value for key, value in changes.items() if key in values}
    if letter == "e":
        error = EpisodeError(kind="WorkerCrashed", stage="step", message="gone")
        return EpisodeRecord(**values, outcome="error", error=error)  # type: ignore[arg-type]
    won = letter == "+"
    digest = "/".join(str(value) for value in (*values.values(), letter))
    values |= {"n_candidates": 3, "trajectory_sha256": digest, "n_inferences": 60, "success_at_end": won}
    values |= {"first_choice_success": won, "success_step": 30 if won else None, **changes}
    outcome = "success" if won else "failure"
    return EpisodeRecord(**values, outcome=outcome, success_once=won)  # type: ignore[arg-type]


def stored(*groups: list[EpisodeRecord], path: str = "runs/a", **config: object) -> StoredRun:
    description = RunDescription(
        name="demo",
        config=config,  # type: ignore[arg-type]
        recipes={},
        environment={},
        options={},
        command="",
    )
    return StoredRun(path=Path(path), description=description, records=tuple(r for g in groups for r in g))


def only_row(table: Table, policy: str, **values: object) -> Row:
    (row,) = (
        row
        for row in table.rows
        if row.policy == policy and all(getattr(row, name) == value for name, value in values.items())
    )
    return row


def has_note(table: Table, *parts: str) -> bool:
    return any(all(part in note for part in parts) for note in table.notes)


# ------------------------------------------------------------------------------- counting


def test_errors_are_neither_failures_nor_episodes() -> None:
    row = only_row(build_table([stored(episodes("p", "++-e"))]), "p")
    assert (row.n_episodes, row.n_success_once, row.n_errors) == (3, 2, 1)
    assert row.success_once == pytest.approx(2 / 3)


def test_a_row_of_errors_only_is_undefined_everywhere() -> None:
    table = build_table([stored(episodes("p", "ee"))])
    row = only_row(table, "p")
    assert (row.n_episodes, row.n_errors, row.n_runs) == (0, 2, 0)
    defined = {name for name, value in row.to_dict().items() if value is not None}
    # What is counted, what it is, and what chance is on this task, which no episode is needed for.
    assert defined == {
        *("task", "policy", "n_action_steps", "n_episodes", "n_errors", "n_runs"),
        *("chance", "chance_source"),
    }
    line = render(table, "markdown").splitlines()[2]
    assert [cell.strip() for cell in line.strip("|").split("|")] == [
        *(COLOR, "p", "1", "0", "2", "—", "—", "—", "—", "—", "—", "0.33†", "—", "—")
    ]


def test_means_are_over_the_episodes_that_they_speak_of() -> None:
    records = [
        episode("p", 1, "+", success_step=10, n_inferences=4),
        episode(
            "p", 2, "+", success_step=20, n_inferences=6, success_at_end=False, first_choice_success=False
        ),
        episode("p", 3, "-", n_inferences=8),
    ]
    row = only_row(build_table([stored(records)]), "p")
    assert row.mean_success_step == 15  # of the two successes
    assert row.inferences_per_episode == 6
    assert row.success_at_end == pytest.approx(1 / 3)
    assert row.first_choice_success == pytest.approx(1 / 3)


def test_success_at_end_is_undefined_where_episodes_stop_at_success() -> None:
    # It is then known of failures only; their mean, 0, would be wrong.
    records = [episode("p", 1, "+", success_at_end=None), episode("p", 2, "-")]
    assert only_row(build_table([stored(records)]), "p").success_at_end is None


def test_there_is_no_first_choice_without_candidates() -> None:
    records = episodes("p", "+-", task=INTERCEPT, n_candidates=None, first_choice_success=None)
    assert only_row(build_table([stored(records)]), "p").first_choice_success is None


def test_a_run_folder_given_twice_counts_once() -> None:
    run = stored(episodes("p", "++--e"))
    row = only_row(build_table([run, run]), "p")
    assert (row.n_episodes, row.n_errors, row.n_runs) == (4, 1, 1)


def test_nothing_to_report_is_said() -> None:
    with pytest.raises(ReportError, match="runs/a: there is no episode to report yet"):
        build_table([stored([])])


# ------------------------------------------------------------------------------- intervals


def test_one_run_has_a_wilson_interval_and_no_sem() -> None:
    # 8 of 10: centre 0.71674, half width 0.22657 (see test_estimates).
    table = build_table([stored(episodes("p", "++++++++--"))])
    row = only_row(table, "p")
    assert (row.interval, row.n_runs, row.sem) == ("wilson", 1, None)
    assert (row.ci_low, row.ci_high) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert has_note(table, "one run: 95 % Wilson interval")


def test_several_runs_have_a_mean_of_means_with_sem_and_t_interval() -> None:
    # Run means 0.5, 0.6, 0.7: SEM 0.1/sqrt(3) = 0.057735, half width 4.302653 * SEM = 0.248414.
    groups = [episodes("p", "+" * n + "-" * (10 - n), run=run) for run, n in enumerate((5, 6, 7))]
    table = build_table([stored(*groups)])
    row = only_row(table, "p")
    assert (row.interval, row.n_runs, row.n_episodes) == ("t_over_runs", 3, 30)
    assert row.success_once == pytest.approx(0.6)
    assert row.sem == pytest.approx(0.057735, abs=1e-6)
    assert (row.ci_low, row.ci_high) == pytest.approx((0.351586, 0.848414), abs=1e-6)
    assert has_note(table, "mean of the run means ± SEM")
    assert "0.60 ± 0.06 [0.35, 0.85]" in render(table, "markdown")


def test_runs_weigh_the_same_whatever_their_size() -> None:
    # Run 0: 1 of 2, run 1: 0 of 4: mean of run means 0.25, not 1/6.
    table = build_table([stored(episodes("p", "+-"), episodes("p", "----", run=1))])
    assert only_row(table, "p").success_once == 0.25


def test_runs_without_spread_keep_an_interval_and_are_named() -> None:
    # A t interval would be [0.75, 0.75]; Wilson's of 3 of 4 is what one run leaves open.
    table = build_table([stored(*(episodes("oracle", "+++-", run=run) for run in range(3)))])
    row = only_row(table, "oracle")
    assert (row.sem, row.n_runs, row.interval) == (0.0, 3, "wilson")
    assert row.ci_low is not None and row.ci_high is not None
    assert row.ci_low < 0.5 < 0.9 < row.ci_high
    assert has_note(table, "SEM is exactly 0 for oracle on RememberColor3-v0 K=1", "deterministic controls")


def test_a_run_of_errors_only_is_no_run() -> None:
    row = only_row(build_table([stored(episodes("p", "+-"), episodes("p", "ee", run=1))]), "p")
    assert (row.n_runs, row.n_errors, row.interval) == (1, 2, "wilson")


# ------------------------------------------------------------------------------- several folders


def test_the_same_episodes_in_two_folders_are_counted_once() -> None:
    table = build_table([stored(episodes("p", "++--")), stored(episodes("p", "++--"), path="runs/b")])
    row = only_row(table, "p")
    assert (row.n_episodes, row.n_runs) == (4, 1)
    assert has_note(table, "runs/b: 4 episodes with the same trajectory as in another run folder")


@pytest.mark.parametrize("seeds", [(1, 2), (3, 4)])
def test_episodes_of_other_weights_are_a_further_run_even_if_they_end_alike(seeds: tuple[int, ...]) -> None:
    """Two trainings that learned nothing may move alike; they are two trainings all the same."""
    one = stored(episodes("p", "--"))
    other = stored([episode("p", seed, "-") for seed in seeds], path="runs/b")
    weights = [{"checkpoints/p": digest, "policies/p": "f00d"} for digest in ("1", "2")]
    described = [
        replace(run, description=replace(run.description, recipes=recipes))
        for run, recipes in zip((one, other), weights, strict=True)
    ]
    row = only_row(build_table(described), "p")
    assert (row.n_runs, row.n_episodes) == (2, 4)
    again = [described[0], replace(described[0], path=Path("runs/c"))]
    assert only_row(build_table(again), "p").n_episodes == 2


def test_equal_keys_with_other_trajectories_are_a_further_run() -> None:
    other = [episode("p", seed, "-", trajectory_sha256=f"other {seed}") for seed in (1, 2)]
    table = build_table([stored(episodes("p", "++")), stored(other, path="runs/b")])
    row = only_row(table, "p")
    assert (row.n_runs, row.n_episodes, row.success_once) == (2, 4, 0.5)
    assert has_note(table, "runs/b: repeats episodes", "count as further runs")


def test_records_without_a_digest_are_not_taken_for_the_same() -> None:
    records = [episode("p", 1, "+", trajectory_sha256=None)]
    table = build_table([stored(records), stored(records, path="runs/b")])
    assert only_row(table, "p").n_runs == 2


def test_seeds_spread_over_folders_are_one_run() -> None:
    table = build_table([stored(episodes("p", "+-")), stored([episode("p", 3, "+")], path="runs/b")])
    row = only_row(table, "p")
    assert (row.n_runs, row.n_episodes) == (1, 3)


def test_a_continued_copy_of_a_folder_replaces_its_errors() -> None:
    table = build_table([stored(episodes("p", "+-e")), stored(episodes("p", "+-+"), path="runs/b")])
    row = only_row(table, "p")
    assert (row.n_runs, row.n_episodes, row.n_errors) == (1, 3, 0)


def test_the_errors_of_a_further_run_do_not_vanish_behind_the_results_of_the_first() -> None:
    table = build_table([stored(episodes("p", "++")), stored(episodes("p", "ee"), path="runs/b")])
    row = only_row(table, "p")
    assert (row.n_runs, row.n_episodes, row.n_errors) == (1, 2, 2)


@pytest.mark.parametrize(
    "changed",
    [
        {"env": {"delay_steps": 5}},
        {"chunking": {"delay_steps": 2}},
        {"render": {"wrist_mesh": "simplified"}},
        {"stop_at_success": True},
        {"prompt_set": "mine"},
        {"simulator": "fake"},
        {"sim_backend": "gpu"},
        {"task_versions": {COLOR: 2}},
    ],
)
def test_runs_with_other_settings_are_never_put_together(changed: dict[str, object]) -> None:
    table = build_table(
        [
            stored(episodes("p", "+-"), task_versions={COLOR: 1}),
            stored(episodes("p", "--"), path="runs/b", **{"task_versions": {COLOR: 1}, **changed}),
        ]
    )
    assert [row.n_episodes for row in table.rows] == [2, 2]
    assert len({row.variant for row in table.rows}) == 2 and None not in {row.variant for row in table.rows}
    assert "| variant" in render(table, "markdown")


def test_prompts_of_one_name_but_other_content_are_not_put_together() -> None:
    runs = [
        StoredRun(
            path=run.path,
            description=replace(run.description, recipes={"prompts/paper": digest, "policies/p": digest}),
            records=run.records,
        )
        for run, digest in (
            (stored(episodes("p", "+")), "aa"),
            (stored(episodes("p", "-"), path="runs/b"), "bb"),
        )
    ]
    assert [row.variant for row in build_table(runs).rows] == ["prompts/paper=aa", "prompts/paper=bb"]


def test_a_variant_says_what_is_different() -> None:
    table = build_table(
        [stored(episodes("p", "+")), stored(episodes("p", "-"), path="runs/b", env={"delay_steps": 5})]
    )
    assert [row.variant for row in table.rows] == ["env.delay_steps=default", "env.delay_steps=5"]


def test_one_variant_has_no_column() -> None:
    table = build_table(
        [stored(episodes("p", "+"), env={"delay_steps": 5}, task_versions={COLOR: 1, "X": 2})]
    )
    assert table.rows[0].variant is None
    assert "variant" not in render(table, "markdown")


def test_another_environment_or_recipe_is_named() -> None:
    one, other = stored(episodes("p", "+")), stored(episodes("q", "+"), path="runs/b")
    runs = []
    for run, commit, digest in ((one, "c1", "aa"), (other, "c2", "bb")):
        description = RunDescription(
            name="demo",
            config={},
            recipes={"policies/p": digest},
            environment={"vla_eval": {"commit": commit, "changes": None}, "python": "3.12"},
            options={},
            command="",
        )
        runs.append(StoredRun(path=run.path, description=description, records=run.records))
    table = build_table(runs)
    assert has_note(table, "different environments; what differs: vla_eval.commit.")
    assert has_note(table, "different contents of policies/p")


def test_a_run_that_was_continued_elsewhere_is_named() -> None:
    session = Session(
        started_at="2030-01-01T00:00:00+00:00",
        command="",
        options={},
        environment_changes=(Change("environment.device.gpu", '"H200"', '"A100"'),),
    )
    run = stored(episodes("p", "+"))
    table = build_table(
        [StoredRun(path=run.path, description=run.description, records=run.records, sessions=(session,))]
    )
    assert has_note(table, "runs/a was continued in another environment", "environment.device.gpu")


def test_figures_of_the_fake_simulator_are_called_worthless() -> None:
    table = build_table([stored(episodes("p", "+"), simulator="fake")])
    assert has_note(table, "fake simulator", "mean nothing")


def test_what_holds_for_many_folders_is_said_once() -> None:
    runs = [stored([episode("p", seed, "+")], path=f"runs/{seed}", simulator="fake") for seed in range(1, 12)]
    notes = [note for note in build_table(runs).notes if "fake simulator" in note]
    assert notes == [
        "runs/1 and 10 more run folders: made with the fake simulator, which has no physics; its rates mean "
        "nothing."
    ]


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
    assert has_note(table, "p takes pairs of several runs as independent")


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


def test_without_random_there_is_no_comparison_and_no_complaint() -> None:
    table = build_table([stored(episodes("p", "+"))])
    assert table.baseline is None and table.rows[0].baseline is None
    assert table.rows[0].paired_difference is None


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
    assert (table.rows[0].chance, table.rows[0].chance_source) == (None, None)
    assert has_note(table, "chance is unknown for InterceptMedium-v0 K=1", "run `cue_blind`")


def test_a_ceiling_at_chance_leaves_no_room_for_a_score() -> None:
    groups = (episodes("p", "+-"), episodes("cue_blind", "+-"), episodes("oracle", "+-"))
    assert only_row(build_table([stored(*groups)]), "p").chance_corrected is None


def test_a_tour_that_succeeds_takes_away_the_meaning_of_success() -> None:
    # 10 of 10: the Wilson interval begins at 10/(10 + 3.84) = 0.72, above 1/3.
    table = build_table([stored(episodes("tour", "+" * 10))])
    assert has_note(table, "RememberColor3-v0 K=1: `tour` reaches 1.00", "not by itself evidence of memory")


def test_a_tour_at_chance_is_no_reason_for_a_warning() -> None:
    # 4 of 10: the interval is [0.17, 0.69] and contains 1/3.
    assert not has_note(build_table([stored(episodes("tour", "++++------"))]), "tour")


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


# ------------------------------------------------------------------------------- formats


def a_table() -> Table:
    groups = (episodes("my_policy", "++-e"), episodes("random", "----"), episodes("tour", "e"))
    return build_table([stored(*groups)])


def test_markdown_columns_are_aligned() -> None:
    lines = [line for line in render(a_table(), "markdown").splitlines() if line.startswith("|")]
    assert len({len(line) for line in lines}) == 1
    positions = [[i for i, char in enumerate(line) if char == "|"] for line in lines]
    assert all(found == positions[0] for found in positions)


def test_json_holds_every_column_and_null_where_undefined() -> None:
    data = json.loads(render(a_table(), "json"))
    required = """task policy n_action_steps n_episodes n_success_once success_once ci_low ci_high interval
        n_runs sem success_at_end first_choice_success n_errors mean_success_step inferences_per_episode
        baseline paired_difference n_pairs paired_p paired_p_raw chance chance_source ceiling
        chance_corrected variant"""
    assert set(required.split()) <= set(data["rows"][0])
    assert data["rows"][0]["ceiling"] is None and data["rows"][2]["success_once"] is None
    assert data["notes"] == list(a_table().notes)


def test_csv_holds_the_columns_of_the_json_and_nothing_else() -> None:
    rows = list(csv.DictReader(io.StringIO(render(a_table(), "csv"))))
    data = json.loads(render(a_table(), "json"))["rows"]
    assert list(rows[0]) == list(data[0])
    assert [row["policy"] for row in rows] == ["my_policy", "random", "tour"]
    assert float(rows[0]["success_once"]) == data[0]["success_once"]
    assert rows[2]["success_once"] == ""


def test_latex_is_booktabs_with_everything_escaped() -> None:
    text = render(a_table(), "latex")
    for part in (r"\toprule", r"\midrule", r"\bottomrule", r"my\_policy", "---", r"\texttt{cue\_blind}"):
        assert part in text
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len({line.count(" & ") for line in body}) == 1
    assert not set("—±×†π“”") & set(text)


@pytest.mark.parametrize("fmt", FORMATS)
def test_a_difference_that_rounds_to_nothing_is_not_minus_zero(fmt: str) -> None:
    groups = episodes("p", "+" + "-" * 300), episodes("random", "++" + "-" * 299)
    assert "-0.00 " not in render(build_table([stored(*groups)]), fmt)  # type: ignore[arg-type]


def test_the_papers_figures_stand_apart_and_are_marked() -> None:
    text = render(a_table(), "markdown", paper=True)
    ours, theirs = text.split("The paper's figures, not measured here (mean ± SEM, 3 runs × 100 episodes)")
    assert "OpenVLA" not in ours
    # The paper's table, row OpenVLA (K = 8), column RememberColor3.
    assert "| RememberColor3-v0 | OpenVLA       |  8 |          0.59 ± 0.04 |" in theirs
    assert "ShellGameTouch" not in theirs


def test_the_papers_figures_are_marked_in_the_other_formats_too() -> None:
    data = json.loads(render(a_table(), "json", paper=True))
    assert len(data["rows"]) == 3 and len(data["paper"]["rows"]) == 5
    rows = list(csv.DictReader(io.StringIO(render(a_table(), "csv", paper=True))))
    assert [row["source"] for row in rows] == ["measured"] * 3 + ["paper"] * 5
    assert "The paper's figures, not measured here" in render(a_table(), "latex", paper=True)


def test_tasks_that_the_paper_did_not_measure_get_no_figures() -> None:
    table = build_table([stored(episodes("p", "+", task="Mine-v0"))])
    assert "has none of these tasks" in render(table, "markdown", paper=True)


# ------------------------------------------------------------------------------- command line


def arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    report_verb.add_parser(parser.add_subparsers(dest="verb"))
    return parser.parse_args(["report", *words])


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    description = stored([]).description
    with RunFolder.open(tmp_path / "demo", description) as folder:
        for record in (*episodes("p", "+-"), *episodes("random", "--")):
            folder.append(record)
    return tmp_path / "demo"


def test_report_prints_the_table_and_nothing_else(
    run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report_verb.run(arguments(str(run_folder), "--format", "json")) == 0
    captured = capsys.readouterr()
    assert [row["policy"] for row in json.loads(captured.out)["rows"]] == ["p", "random"]
    assert captured.err == ""


def test_the_notes_of_a_csv_go_to_standard_error(
    run_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report_verb.run(arguments(str(run_folder), "--format", "csv"))
    captured = capsys.readouterr()
    assert captured.out.count("\n") == 3
    assert "note: vs random" in captured.err


def test_the_baseline_random_is_an_error_only_if_it_was_asked_for(tmp_path: Path) -> None:
    with RunFolder.open(tmp_path / "demo", stored([]).description) as folder:
        folder.append(episode("p", 1, "+"))
    assert report_verb.run(arguments(str(tmp_path / "demo"))) == 0
    with pytest.raises(UnknownNameError, match="there is no policy 'random'"):
        report_verb.run(arguments(str(tmp_path / "demo"), "--baseline", "random"))


def test_report_offers_the_formats_that_there_are() -> None:
    assert report_verb.FORMATS == FORMATS


def test_help_does_not_wait_for_scipy_and_a_report_needs_no_torch(run_folder: Path) -> None:
    code = (
        "import sys, argparse, vla_eval.cli.report as verb\n"
        "print('scipy' in sys.modules)\n"
        "parser = argparse.ArgumentParser(); verb.add_parser(parser.add_subparsers())\n"
        f"verb.run(parser.parse_args(['report', {str(run_folder)!r}]))\n"
        "heavy = ('torch', 'sapien', 'mani_skill', 'lerobot', 'cv2', 'rerun', 'pandas')\n"
        "print([name for name in heavy if name in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    first, *_, last = output.stdout.splitlines()
    assert (first, last) == ("False", "[]")
