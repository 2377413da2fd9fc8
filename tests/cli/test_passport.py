"""`mikasa-vla passport`: one figure, two that differ, and what it does not know."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest

from tests.evaluation.resolved import evaluate
from vla_eval.cli.main import main
from vla_eval.config.evaluation import EvalConfig
from vla_eval.workers.in_process import IN_PROCESS

ONE = EvalConfig(
    name="one",
    tasks=("RememberColor3-v0",),
    policies=("oracle",),
    n_action_steps=(4,),
    episodes=3,
    simulator="fake",
    workers=1,
)
OTHER = replace(ONE, name="other", n_action_steps=(8,), episodes=2, env={"horizon_steps": 90})


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    folder = tmp_path_factory.mktemp("runs")
    for config in (ONE, OTHER):
        evaluate(config, out=folder / config.name, backend=IN_PROCESS)
    return str(folder / "one"), str(folder / "other")


def test_one_passport_is_printed_and_two_say_what_differs(
    runs: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["passport", runs[0]]) == 0
    alone = capsys.readouterr().out
    assert "| K " in alone and "differs" not in alone
    assert main(["passport", *runs]) == 0
    text = capsys.readouterr().out
    assert "- Not to be ranked: K differs." in text
    # The fake simulator's usual horizon is not the task's.
    assert "- Not to be ranked: not known of one or both: control mode, image size and horizon." in text
    assert "2 seeds in common, of 3 and 2." in text
    assert main(["passport", runs[0], runs[0]]) == 0
    assert "they may be ranked" in capsys.readouterr().out.lower()


def test_a_published_result_stands_beside_a_run(
    runs: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["passport", runs[0], "SimpleMemVLA", "--format", "json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert [one["subject"] for one in data["passports"]] == [runs[0], "SimpleMemVLA (published)"]
    assert data["passports"][1]["n_action_steps"] is None  # 8 is inferred, not stated
    assert {"field": "n_action_steps", "kind": "setting", "is_known": False} in data["differences"]


def test_of_a_published_result_the_horizons_of_the_runs_tasks_are_compared(
    runs: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["passport", runs[1], "GMP", "--format", "csv"]) == 0
    told = capsys.readouterr()
    rows = {row["field"]: row for row in csv.DictReader(io.StringIO(told.out))}
    assert rows["horizon"]["GMP K=2 (published)"] == "60 control steps"  # of RememberColor3 alone
    assert rows["horizon"][runs[1]] == "90 control steps"
    assert rows["horizon"]["same?"] == "differs"
    assert "note: Not to be ranked: " in told.err


def test_a_run_without_an_episode_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["passport", str(tmp_path / "nothing")]) == 1
    assert "nothing" in capsys.readouterr().err
