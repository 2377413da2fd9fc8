"""Verbs that need a robot say so of a task of MIKASA-Base; the others explain it."""

import pytest

from vla_eval.cli.main import main

TASK = "mikasa_base/T-Maze-v0"


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["probe", "--task", TASK, "--policy", "oracle"], "`probe` changes a robot's task"),
        (["probe", "--grid", "--task", TASK, "--policy", "oracle"], "`probe --grid` changes a robot's task"),
        (["record", "--task", TASK, "--episodes", "2"], "`record` makes demonstrations of a robot's task"),
        (
            ["audit", "--task", TASK, "RememberColor3-v0"],
            "an audit with an arm's controls is of a robot's task",
        ),
        (["check", "random", "--task", TASK], "`check` gives a policy the observations of a robot's task"),
        (["show", "mikasa_base/T-Maz-v0"], "Did you mean 'mikasa_base/T-Maze-v0'?"),
        (["eval", "--task", TASK, "--policy", "oracle", "--set", "simulator=fake"], "needs no simulator"),
    ],
)
def test_what_needs_a_robot_is_refused_in_one_message(
    command: list[str], said: str, capsys: pytest.CaptureFixture[str], tmp_path: object
) -> None:
    out = [] if command[0] in ("show", "check") else ["--out", f"{tmp_path}/out"]
    assert main([*command, *out]) == 1
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error


def test_show_says_what_is_to_be_remembered_and_what_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", TASK]) == 0
    printed = capsys.readouterr().out
    for line in ("1 bit for 10 steps", "11 steps", "memoryless 0.5, best 1", "twni2016/Memory-RL at c9b8b39"):
        assert line in printed


def test_tasks_are_listed_by_type_of_memory(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "tasks", "--suite", "mikasa_base", "--memory", "spatial"]) == 0
    printed = capsys.readouterr().out
    assert "mikasa_base/MysteryPath-v0" in printed and "LabyrinthEscapeEasy" in printed
    assert "RepeatFirst" not in printed
    assert main(["list", "tasks", "--memory", "sequential"]) == 0
    assert "ChainOfColors3-v0" in capsys.readouterr().out


def test_a_whole_suite_leaves_out_what_takes_hours_and_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "--suite", "mikasa_base", "--policy", "oracle", "--dry-run"]) == 0
    printed = capsys.readouterr()
    assert "left out of --suite mikasa_base" in printed.err and "mikasa_base/MemoryMaze-9x9-v0" in printed.err
    assert "MemoryMaze" not in printed.out and "mikasa_base/ViZDoomTwoColorsHard-v0" in printed.out
