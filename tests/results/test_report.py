"""The success table: what is put together, what is counted, what is left undefined."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

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
from vla_eval.errors import ReportError
from vla_eval.results.report import build_table, render
from vla_eval.storage.run_file import Change, JsonValue
from vla_eval.storage.run_folder import RunDescription, Session, StoredRun

# ------------------------------------------------------------------------------- counting


def test_errors_are_neither_failures_nor_episodes() -> None:
    row = only_row(build_table([stored(episodes("p", "++-e"))]), "p")
    assert (row.n_episodes, row.n_success_once, row.n_errors) == (3, 2, 1)
    assert row.success_once == pytest.approx(2 / 3)


def test_a_row_of_errors_only_is_undefined_everywhere() -> None:
    table = build_table([stored(episodes("p", "ee"))])
    row = only_row(table, "p")
    assert (row.n_episodes, row.n_errors, row.n_runs) == (0, 2, 0)
    defined = {name for name, value in vars(row).items() if value is not None}
    # What is counted, what it is, and what chance is on this task, which no episode is needed for.
    assert defined == {
        *("task", "policy", "n_action_steps", "n_episodes", "n_errors", "n_runs"),
        *("chance", "chance_source"),
    }
    same, _, titles, _, line = render(table, "markdown").splitlines()[:5]
    assert same == f"All rows: task {COLOR}, K 1, chance 0.33†, episodes 0, errors 2."
    cells = [[cell.strip() for cell in text.strip("|").split("|")] for text in (titles, line)]
    assert cells == [["policy", "success once"], ["p", "—"]]  # no column is empty


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


def of_checkpoints(run: StoredRun, **digests: str) -> StoredRun:
    recipes = {f"checkpoints/p/run-{name.removeprefix('run_')}": digest for name, digest in digests.items()}
    return replace(run, description=replace(run.description, recipes=recipes))


def test_the_runs_of_a_row_are_rows_of_the_wide_table_and_none_of_the_other() -> None:
    # Run means 1 and 1/2.
    records = [*episodes("p", "++++"), *episodes("p", "+-+-", run=1), *episodes("random", "----")]
    table = build_table([stored(records)])

    assert [(row.policy, row.success_once) for row in cells_of(table)] == [("p", 0.75), ("random", 0.0)]
    runs = [SimpleNamespace(**row.to_dict()) for row in table.run_rows]
    assert [(row.run, row.n_episodes, row.success_once) for row in runs] == [(0, 4, 1), (1, 4, 0.5)]
    assert all(row.paired_difference is None for row in runs)
    first_column = [
        line.split("|")[2].strip()
        for line in render(table, "markdown", wide=True).splitlines()
        if line.startswith("|")
    ]
    assert first_column[2:] == ["p", "p, run 0", "p, run 1", "random"]
    assert "run 0" not in render(table, "markdown")
    assert [row["run"] for row in json.loads(render(table, "json"))["run_rows"]] == [0, 1]


def test_a_baseline_of_fewer_runs_is_compared_over_those_it_has_and_that_is_noted() -> None:
    records = [*episodes("p", "++++"), *episodes("p", "+-+-", run=1), *episodes("cue_blind", "----")]
    table = build_table([stored(records)])
    assert only_row(table, "p").n_pairs == 4
    assert has_note(table, "vs cue_blind", "p on RememberColor3-v0 K=1 (1 of 2 runs)", "--runs")


def test_a_folder_with_a_further_checkpoint_repeats_none_of_the_earlier_ones() -> None:
    one = of_checkpoints(stored(episodes("p", "++--")), run_0="aa")
    records = [*episodes("p", "++--"), *episodes("p", "+++-", run=1)]
    both = of_checkpoints(stored(records, path="runs/b"), run_0="aa", run_1="bb")

    row = only_row(build_table([one, both]), "p")

    assert (row.n_runs, row.n_episodes) == (2, 8)


def test_success_at_end_is_undefined_where_episodes_stop_at_success() -> None:
    # It is then known of failures only; their mean, 0, would be wrong.
    records = [episode("p", 1, "+", success_at_end=None), episode("p", 2, "-")]
    assert only_row(build_table([stored(records)]), "p").success_at_end is None


def test_of_the_episodes_that_chose_it_is_told_how_many_chose_right() -> None:
    """An arm that often touches nothing: its success says how it aims, this what it knows."""
    records = [
        *episodes("p", "++", first_choice=1),
        episode("p", 3, "-", first_choice=2),
        episode("p", 4, "+", first_choice=0, first_choice_success=False),  # the right one later on
        *(episode("p", seed, "-") for seed in (5, 6, 7)),
        episode("p", 8, "e"),
    ]
    row = only_row(build_table([stored(records)]), "p")
    assert (row.n_chose, row.n_chose_right) == (4, 2)
    # Wilson, 2 of 4: 0.5 ± 1.96 * sqrt(1/16 + 0.9604 / 16) / 1.9604, with z² / n = 0.9604
    assert row.right_if_chose == 0.5
    assert (row.right_if_chose_low, row.right_if_chose_high) == pytest.approx((0.15, 0.85), abs=1e-3)
    shown = render(build_table([stored(records)]), "markdown", columns=["chose", "right_if_chose"])
    assert [cell.strip() for cell in shown.splitlines()[2].strip("|").split("|")] == [
        "4",
        "0.50 [0.15, 0.85]",
    ]
    nobody = render(
        build_table([stored(episodes("p", "--"))]), "markdown", columns=["chose", "right_if_chose"]
    )
    assert [cell.strip() for cell in nobody.splitlines()[2].strip("|").split("|")] == ["0", "—"]


def test_what_was_chosen_in_several_runs_has_no_interval_over_episodes() -> None:
    runs = [record for run in (0, 1) for record in episodes("p", "+-", run=run, first_choice=1)]
    shown = render(build_table([stored(runs)]), "markdown", columns=["chose", "right_if_chose"])
    assert [cell.strip() for cell in shown.splitlines()[2].strip("|").split("|")] == ["4", "0.50"]


def test_there_is_no_first_choice_without_candidates() -> None:
    records = episodes("p", "+-", task=INTERCEPT, n_candidates=None, first_choice_success=None)
    row = only_row(build_table([stored(records)]), "p")
    assert row.first_choice_success is row.n_chose is row.n_chose_right is row.right_if_chose is None


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
    assert [row.n_episodes for row in cells_of(table)] == [2, 2]
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
    assert [row.variant for row in table.rows] == ["default", "env.delay_steps=5"]


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


def environment_notes(*environments: dict[str, JsonValue]) -> list[str]:
    """What a table of one run per environment says of the environments."""
    runs = []
    for index, environment in enumerate(environments):
        description = RunDescription(
            name="demo", config={}, recipes={}, environment=environment, options={}, command=""
        )
        run = stored(episodes(f"p{index}", "+"), path=f"runs/{index}")
        runs.append(StoredRun(path=run.path, description=description, records=run.records))
    return [note for note in build_table(runs).notes if "different environments" in note]


def test_a_run_without_pictures_differs_in_no_renderer() -> None:
    """Scripted policies see none: such a run has no renderer, where others may have two."""
    blind: dict[str, JsonValue] = {"device": {"simulator": "physx_cpu"}}
    software: dict[str, JsonValue] = {"device": {"simulator": "physx_cpu", "render_device": "llvmpipe"}}
    gpu: dict[str, JsonValue] = {"device": {"simulator": "physx_cpu", "render_device": "H100"}}

    assert environment_notes(software, blind, software) == []
    (told,) = environment_notes(software, blind, gpu)
    assert told.endswith("what differs: device.render_device.")


def test_a_run_of_which_no_worker_has_started_differs_in_no_device() -> None:
    begun: dict[str, JsonValue] = {"python": "3.12"}
    cpu: dict[str, JsonValue] = {"python": "3.12", "device": {"simulator": "physx_cpu"}}
    gpu: dict[str, JsonValue] = {"python": "3.12", "device": {"simulator": "physx_cuda"}}

    assert environment_notes(cpu, begun) == []
    (told,) = environment_notes(cpu, begun, gpu)
    assert told.endswith("what differs: device.simulator.")


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
    assert has_note(table, "runs/a was resumed in another environment", "environment.device.gpu")


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
