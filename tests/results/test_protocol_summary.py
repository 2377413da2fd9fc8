"""The summary figure of a protocol: how it is computed, and that what departs from it has none."""

import csv
import io
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from tests.results.stored_runs import COLOR, INTERCEPT, episode, episodes, has_note, stored
from vla_eval.config.files import list_recipes
from vla_eval.config.protocol import Protocol, load_protocol
from vla_eval.errors import UnknownNameError
from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import wilson_interval
from vla_eval.results.report import build_table, render
from vla_eval.results.success_table import ProtocolRow, Table
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.catalog import task_spec

VERSIONS = {COLOR: 1, INTERCEPT: 1}
PROTOCOL = f"""
name: two
version: 2
description: two tasks, four seeds
source: here
tasks: {{{COLOR}: 1, {INTERCEPT}: 1}}
episodes: 4
seed_start: 1
"""


@pytest.fixture(autouse=True)
def two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write the protocol `two` where it is found."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "protocols" / "two.yaml"
    path.parent.mkdir()
    path.write_text(PROTOCOL)
    return path


def both_tasks(color: str = "+++-", intercept: str = "+---", **changes: object) -> list[EpisodeRecord]:
    return [
        *episodes("p", color, task=COLOR, **changes),
        *episodes("p", intercept, task=INTERCEPT, **changes),
    ]


def summary_of(*runs: StoredRun) -> tuple[Table, ProtocolRow]:
    table = build_table(runs, protocols=["two"])
    (row,) = table.protocols
    return table, row


def test_the_figure_is_the_mean_over_the_tasks_with_an_interval_over_the_episodes() -> None:
    _, row = summary_of(stored(both_tasks(), task_versions=VERSIONS))
    assert (row.mean, row.n_tasks, row.n_runs, row.sem) == (0.5, 2, 1, None)  # of 3/4 and 1/4
    assert (row.lowest, row.highest, row.interval) == (0.25, 0.75, "wilson_over_tasks")
    one, other = wilson_interval(3, 4), wilson_interval(1, 4)
    assert one is not None and other is not None
    below = math.hypot(0.75 - one.low, 0.25 - other.low) / 2
    assert row.ci_low == pytest.approx(0.5 - below)
    assert row.ci_high == pytest.approx(0.5 + below)  # 3/4 and 1/4 mirror each other


def test_with_several_runs_the_interval_is_over_the_means_of_the_runs() -> None:
    # Run means (3/4 + 1/4)/2 = 1/2 and (1 + 1)/2 = 1: mean 3/4, SEM 1/4, t of one degree 12.7.
    records = [*both_tasks(), *both_tasks("++++", "++++", run=1)]
    _, row = summary_of(stored(records, task_versions=VERSIONS))
    assert (row.mean, row.sem, row.n_runs, row.interval) == (0.75, 0.25, 2, "t_over_runs")
    assert (row.ci_low, row.ci_high) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("color", "config", "departure"),
    [
        ("++-", {}, "3 of 4 seeds in RememberColor3-v0"),
        ("++-e", {}, "3 of 4 seeds (1 errors) in RememberColor3-v0"),
        ("++-+-", {}, "1 seeds outside of 1 to 4 in RememberColor3-v0"),
        ("+++-", {"env": {"control_mode": "pd_joint_pos"}}, "env.control_mode=pd_joint_pos"),
        ("+++-", {"chunking": {"delay_steps": 2}}, "chunking.delay_steps=2"),
        ("+++-", {"task_versions": {COLOR: 3, INTERCEPT: 1}}, "RememberColor3-v0 of version 3 instead of 1"),
        ("+++-", {"task_versions": {INTERCEPT: 1}}, "RememberColor3-v0 of unknown version instead of 1"),
    ],
)
def test_what_departs_is_said_and_there_is_no_figure(
    color: str, config: dict[str, object], departure: str
) -> None:
    table, row = summary_of(stored(both_tasks(color), **{"task_versions": VERSIONS, **config}))
    assert (row.mean, row.ci_low, row.departures) == (None, None, (departure,))
    text = render(table, "markdown")
    assert "not the protocol" in text
    assert departure in text


def test_missing_tasks_and_missing_runs_depart(two: Path) -> None:
    two.write_text(PROTOCOL + "runs: 3\n")
    _, row = summary_of(stored(episodes("p", "++++"), task_versions=VERSIONS))
    assert row.departures == (f"1 of 2 tasks, without {INTERCEPT}", "1 of 3 runs")


def test_one_checkpoint_evaluated_twice_is_not_two_training_runs(two: Path) -> None:
    two.write_text(PROTOCOL + "runs: 2\n")
    run = stored([*both_tasks(), *both_tasks("++++", run=1)], task_versions=VERSIONS)
    same = {"checkpoints/p": "aa"}
    _, row = summary_of(replace(run, description=replace(run.description, recipes=same)))
    assert row.departures == ("the same weights in several runs instead of 2 training runs",)
    others = {"checkpoints/p/run-0": "aa", "checkpoints/p/run-1": "bb"}
    _, row = summary_of(replace(run, description=replace(run.description, recipes=others)))
    assert row.departures == ()


def test_settings_that_are_free_or_move_no_rate_do_not_depart(two: Path) -> None:
    two.write_text(PROTOCOL + "free: [env.control_mode]\n")
    config = {"env": {"control_mode": "pd_joint_pos"}, "stop_at_success": True, "render": {"backend": "cpu"}}
    _, row = summary_of(stored(both_tasks(), task_versions=VERSIONS, **config))
    assert row.departures == ()


def test_each_group_of_tasks_has_a_figure_of_its_own(two: Path) -> None:
    two.write_text(PROTOCOL + f"groups: {{Color: [{COLOR}], Ball: [{INTERCEPT}]}}\n")
    table = build_table([stored(both_tasks(), task_versions=VERSIONS)], protocols=["two"])
    assert [(row.group, row.mean) for row in table.protocols] == [("Color", 0.75), ("Ball", 0.25)]


def test_every_format_has_the_figure_apart_from_measured_rows() -> None:
    table, _ = summary_of(stored(both_tasks(), task_versions=VERSIONS))
    lines = list(csv.DictReader(io.StringIO(render(table, "csv"))))
    assert [line["source"] for line in lines] == ["measured", "measured", "protocol two v2"]
    assert float(lines[2]["success_once"]) == 0.5
    (found,) = json.loads(render(table, "json"))["protocols"]
    assert (found["protocol"], found["mean"], found["departures"]) == ("two", 0.5, [])
    for fmt in ("markdown", "latex", "html-table"):
        assert "two v2" in render(table, fmt).split("Summary figures of protocols")[1]  # type: ignore[arg-type]


def test_a_run_that_names_its_protocol_needs_no_flag_and_a_lost_protocol_is_noted() -> None:
    run = stored(both_tasks(), task_versions=VERSIONS)
    named = replace(run, description=replace(run.description, options={"protocol": "two"}))
    assert [row.mean for row in build_table([named]).protocols] == [0.5]
    lost = replace(run, description=replace(run.description, options={"protocol": "gone"}))
    table = build_table([lost])
    assert table.protocols == ()
    assert has_note(table, "gone", "which the runs name")
    with pytest.raises(UnknownNameError, match="Did you mean 'two'"):
        build_table([run], protocols=["twoo"])


def test_extra_episodes_of_another_policy_make_a_row_of_its_own() -> None:
    records = [*both_tasks(), *(episode("q", seed, "+", task=COLOR) for seed in range(1, 5))]
    table = build_table([stored(records, task_versions=VERSIONS)], protocols=["two"])
    assert [(row.policy, row.mean) for row in table.protocols] == [("p", 0.5), ("q", None)]


@pytest.mark.parametrize("name", list_recipes("protocols"))
def test_a_shipped_protocol_is_of_the_tasks_as_they_are_here(name: str) -> None:
    protocol: Protocol = load_protocol(name).value
    assert {task: task_spec(task).version for task in protocol.tasks} == protocol.tasks
    assert len(protocol.seeds) == (50 if name == "mikasa_vla_90" else 100)
    assert protocol.seeds[0] == (4242424242 if name == "mikasa_vla_90" else 1)
