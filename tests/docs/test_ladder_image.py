"""The figures of the ladder's page."""

from pathlib import Path

import pytest

from scripts.ladder_image import correlation_row, part_of, read_scores, updated, write_scores
from vla_eval.config.agents import AgentTable
from vla_eval.config.files import load_recipe

DIAGNOSTIC, ROBOT = "mikasa_base/MemoryLengthEasy-v0", "RememberColor3-v0"  # both of objects
CORES = ["mlp", "gru", "lstm", "dt", "rate", "mamba", "elmur"]


def row(diagnostic: list[float], robot: list[float]) -> list[str]:
    ends = {
        end: {core: {task: score} for core, score in zip(CORES, scores, strict=True)}
        for end, task, scores in (("diagnostic", DIAGNOSTIC, diagnostic), ("robot", ROBOT, robot))
    }
    return [cell.strip() for cell in correlation_row("object", ends, CORES).strip("| ").split(" | ")]


def test_cores_in_the_same_order_at_both_ends_correlate_with_one() -> None:
    *sizes, rho, p = row([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0, 0.5, 0.51, 0.52, 0.6, 0.9, 1])
    assert sizes == ["object", "7", "1", "1"]
    assert rho.startswith("1.00 [")
    assert float(p) < 0.01  # 2 of 5,040 orders are as far from 0


def test_the_reverse_order_correlates_with_minus_one() -> None:
    rho = row([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [1, 0.9, 0.6, 0.52, 0.51, 0.5, 0])[4]
    assert rho.startswith("\N{MINUS SIGN}1.00 [")


def test_cores_that_are_all_alike_have_no_order() -> None:
    assert row([1.0] * 7, [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])[4] == "all alike at one end"


def test_what_is_given_replaces_all_that_is_kept_of_its_tasks_and_nothing_else(tmp_path: Path) -> None:
    kept = {"gru": {DIAGNOSTIC: 0.9, ROBOT: 0.5}, "dt": {DIAGNOSTIC: 0.8, ROBOT: 0.25}}
    found = updated(kept, [{"gru": {ROBOT: 1.0}}, {"mlp": {ROBOT: 0.125}}])
    assert found == {"gru": {DIAGNOSTIC: 0.9, ROBOT: 1.0}, "dt": {DIAGNOSTIC: 0.8}, "mlp": {ROBOT: 0.125}}
    write_scores(tmp_path / "ladder.csv", found)
    assert read_scores(tmp_path / "ladder.csv") == found
    assert read_scores(tmp_path / "none.csv") == {}


def test_a_core_without_a_score_on_a_task_has_no_rank() -> None:
    scores = {"gru": {DIAGNOSTIC: 0.9, ROBOT: 1.0}, "dt": {DIAGNOSTIC: 0.8}}
    assert part_of(scores, is_base=True) == {"gru": {DIAGNOSTIC: 0.9}, "dt": {DIAGNOSTIC: 0.8}}
    with pytest.raises(SystemExit, match="dt has no score on RememberColor3-v0"):
        part_of(scores, is_base=False)


def test_the_kept_scores_are_of_nine_cores_on_all_tasks_of_the_tables() -> None:
    kept = read_scores(Path("docs/images/ladder.csv"))
    tables = [load_recipe("configs", f"ladder_{part}", AgentTable).value for part in ("base", "robots")]
    assert {*kept} == {*tables[0].variants}
    for core in kept:
        assert {*kept[core]} >= {task for table in tables for task in table.tasks}
