"""MIKASA-Base in an evaluation: what is recorded, what a table shows, what is refused."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.config.eval_configs import config
from tests.evaluation.resolved import evaluate, make_plan
from vla_eval.cli.main import main
from vla_eval.config.evaluation import EvalConfig
from vla_eval.errors import RecipeError, SpecMismatchError, TaskArgumentError, UnknownNameError
from vla_eval.records import EpisodeRecord
from vla_eval.storage.run_folder import read_run

pytestmark = pytest.mark.usefixtures("light_workers")

BIT, CARDS, NUMPAD, BET = (
    f"mikasa_base/{name}"
    for name in ("MemoryLengthEasy-v0", "MemoryCardsEasy-v0", "Numpad-Discrete-v0", "HigherLowerEasy-v0")
)
CONTROLS = ["random", "memoryless", "oracle"]


def _config(**changes: Any) -> EvalConfig:
    fields = {"tasks": [BIT, CARDS], "policies": CONTROLS, "simulator": "maniskill", "episodes": 4, **changes}
    return config(**fields)


def _records(path: Path) -> list[str]:
    return sorted(record.to_json() for record in read_run(path).records)


def test_records_are_equal_for_any_number_of_workers_and_slots(tmp_path: Path) -> None:
    evaluate(_config(workers=1), out=tmp_path / "one")
    evaluate(_config(workers=2, slots_per_worker=3), out=tmp_path / "two")

    assert _records(tmp_path / "one") == _records(tmp_path / "two")
    records = read_run(tmp_path / "one").records
    assert len(records) == 2 * 3 * 4
    for record in records:
        if record.policy == "oracle":
            assert record.outcome == "success" and record.success_step == record.n_steps
        if record.task == BIT:
            # One bit is asked for once: 11 steps, a return of 1 or -1.
            assert record.n_steps == 11
            assert record.episode_return == (1.0 if record.outcome == "success" else -1.0)


def test_a_task_without_a_success_rule_is_neither_won_nor_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("popgym", reason="needs `make base`")
    evaluate(_config(tasks=[BET]), out=tmp_path / "run")

    for record in read_run(tmp_path / "run").records:
        assert record.outcome == "finished" and record.success_once is record.success_at_end is None
        assert record.n_steps == 51 and record.episode_return is not None
        assert EpisodeRecord.from_json(record.to_json(), where="here") == record
    assert main(["report", str(tmp_path / "run"), "--format", "csv"]) == 0
    header, *rows = capsys.readouterr().out.splitlines()
    for row in rows:
        cells = dict(zip(header.split(","), row.split(","), strict=True))
        assert cells["success_once"] == cells["n_success_once"] == ""
        assert -1 <= float(cells["return_mean"]) <= 1
        # The row of the task: 0.496 without memory, 0.527 by counting cards.
        normalised = (float(cells["return_mean"]) - 0.496) / (0.527 - 0.496)
        assert float(cells["return_normalised"]) == pytest.approx(normalised)


def test_a_task_whose_best_memoryless_player_is_unknown_has_no_row_and_no_score_of_it(tmp_path: Path) -> None:
    plan = make_plan(_config(tasks=[NUMPAD]))
    assert {job.group.key.policy for job in plan.jobs} == {"random", "oracle"}
    assert plan.left_out == (f"memoryless on {NUMPAD}: no such player is known for this task",)
    with pytest.raises(RecipeError, match=r"nothing to run \(memoryless on"):
        make_plan(_config(tasks=[NUMPAD], policies=["memoryless"]))


def test_what_a_robot_needs_is_refused_by_name() -> None:
    with pytest.raises(RecipeError, match=r"n_action_steps: \[4\]: mikasa_base/MemoryLengthEasy-v0"):
        make_plan(_config(n_action_steps=[4]))
    with pytest.raises(RecipeError, match=r"chunking\.delay: mikasa_base/.*: no action"):
        make_plan(_config(chunking={"delay_steps": 1}))
    with pytest.raises(SpecMismatchError, match="it has to be trained"):
        make_plan(_config(tasks=["RememberColor3-v0"], policies=["memoryless"]))
    with pytest.raises(SpecMismatchError, match="policy 'memory_color3' is asked with an instruction, and"):
        make_plan(_config(policies=["memory_color3"]))
    with pytest.raises(UnknownNameError, match=r"there is no argument 'horizon_step'\. Did you mean"):
        make_plan(_config(env={"horizon_step": 5}))
    with pytest.raises(TaskArgumentError, match="simulator=fake: mikasa_base/"):
        make_plan(_config(simulator="fake"))
    with pytest.raises(UnknownNameError, match=r"there is no task.*Did you mean 'mikasa_base/T-Maze-v0'"):
        make_plan(_config(tasks=["mikasa_base/T-Maz-v0"]))


@pytest.mark.parametrize("policy", ["hold", "cue_blind"])
def test_controls_of_an_arm_say_that_they_are_for_others(policy: str, tmp_path: Path) -> None:
    with pytest.raises(SpecMismatchError, match=rf"policy '{policy}'"):
        evaluate(_config(policies=[policy]), out=tmp_path / "run")


def test_a_suite_stands_for_its_tasks(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "--suite", "mikasa_bas", "--policy", "oracle"]) == 1
    assert "there is no suite 'mikasa_bas'. Did you mean 'mikasa_base'?" in capsys.readouterr().err
    assert main(["eval", "--suite", "mikasa_base", "--task", BIT, "--policy", "oracle"]) == 1
    assert "name tasks or a suite, not both" in capsys.readouterr().err


def test_scores_are_also_given_by_type_of_memory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tasks = [BIT, "mikasa_base/T-Maze-v0", CARDS, NUMPAD]
    evaluate(_config(tasks=tasks, policies=["oracle"], episodes=2), out=tmp_path / "run")
    assert main(["report", str(tmp_path / "run"), "--format", "json"]) == 0
    found = {one["memory"]: one for one in json.loads(capsys.readouterr().out)["memory_types"]}
    # Both tasks of one bit are solved; that of cards is another type, and Numpad has no score.
    assert found["object"] == {"memory": "object", "policy": "oracle", "n_tasks": 2, "score": 1.0}
    assert found["capacity"]["n_tasks"] == 1 and set(found) == {"object", "capacity"}
    assert main(["report", str(tmp_path / "run")]) == 0
    assert "**MIKASA-Base by type of memory" in capsys.readouterr().out
