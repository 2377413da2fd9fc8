"""Tasks of the official package at the command line, without the package."""

from pathlib import Path

import pytest

from vla_eval.cli.main import main

TASK = "mikasa_vla/TimedTransferEasy-VLA-v0"


def test_the_table_of_an_official_task_is_complete_and_asks_for_no_control(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["eval", "--task", TASK, "--policy", "hold", "random", "--episodes", "2", "--workers", "1"]
    assert main([*command, "--set", "simulator=fake", "--out", str(tmp_path / "run")]) == 0
    printed = capsys.readouterr().out
    assert TASK in printed
    assert "incomplete" not in printed
    assert "cue_blind" not in printed


def test_an_expert_is_refused_where_there_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["eval", "--task", TASK, "--policy", "oracle", "--episodes", "1", "--workers", "1"]
    assert main([*command, "--set", "simulator=fake", "--out", str(tmp_path / "run")]) == 1
    said = capsys.readouterr().err
    assert f"policy 'oracle' needs a scripted expert, and {TASK} has none" in said


def test_each_suite_has_its_list(capsys: pytest.CaptureFixture[str]) -> None:
    main(["list", "tasks", "--suite", "mikasa_vla_90"])
    lines = capsys.readouterr().out.splitlines()
    headings = [line for line in lines if not line.startswith(" ")]
    assert headings == ["short:", "medium:", "long:"]
    assert len(lines) - len(headings) == 90


def test_a_task_is_shown_with_its_phases_and_where_it_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", "mikasa_vla/RememberColor3-VLA-v0"]) == 0
    shown = capsys.readouterr().out
    assert "(rules version 1, object memory, short split)" in shown
    assert "every action is replaced by zeros" in shown
    assert "chance        0.333 for a perfect arm that ignores the cue" in shown
    assert "oracle        vla_eval.oracles.hover:CUBES" in shown
    assert main(["show", TASK]) == 0
    shown = capsys.readouterr().out
    assert "phases        — (not to be read from the environment)" in shown
    assert "oracle        there is none" in shown
