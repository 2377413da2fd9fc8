"""What is printed fits the terminal; what goes to a pipe or a file is not broken into lines."""

import fcntl
import os
import pty
import struct
import sys
import termios

import pytest

from vla_eval.cli.list import print_rows
from vla_eval.cli.main import FIRST_STEPS, main
from vla_eval.cli.terminal.screen import folded, print_markdown, screen_width, wrapped

NOTE = "- success once, one run: 95 % Wilson interval over its episodes; `--wide` shows every column."
TABLE = f"| task | note |\n| ---- | ---- |\n| a | {'b' * 120} |"


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    return monkeypatch


def test_a_note_is_wrapped_at_words_and_indented_below_its_first_word() -> None:
    lines = wrapped(NOTE, 40).splitlines()
    assert max(map(len, lines)) <= 40 and len(lines) == 3
    assert lines[0].startswith("- ") and all(line.startswith("  ") for line in lines[1:])
    assert " ".join(" ".join(lines).split()) == NOTE  # the words are all there


def test_tables_and_words_without_a_space_stay_as_they_are() -> None:
    assert wrapped(TABLE, 60) == TABLE
    path = f"runs/{'x' * 70}:"
    assert wrapped(f"- {path} is incomplete", 40).splitlines() == [f"- {path}", "  is incomplete"]


@pytest.mark.parametrize(("columns", "expected"), [("80", 80), ("0", 100), ("240", 100), ("10", 40)])
def test_lines_are_as_long_as_the_terminal_but_no_longer_than_100(
    terminal: pytest.MonkeyPatch, columns: str, expected: int
) -> None:
    terminal.setenv("COLUMNS", columns)
    terminal.setattr(sys, "__stdout__", None)  # the size of no terminal is known
    assert screen_width() == expected


def test_only_a_terminal_gets_short_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "50")
    print_markdown(NOTE)
    assert capsys.readouterr().out == f"{NOTE}\n"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    print_markdown(NOTE)
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 50


COMMAND = "`mikasa-vla checkpoint fetch smolvla_base`"


@pytest.mark.parametrize("before", range(0, 60, 7))
def test_a_command_in_quotes_is_not_broken_so_that_it_can_be_copied(before: int) -> None:
    text = f"{'word ' * before}first {COMMAND}, then the rest of the sentence"
    lines = folded(text, 60).splitlines()
    assert any(f"{COMMAND}," in line for line in lines)
    assert max(map(len, lines)) <= 60 and " ".join(lines) == text


def test_a_command_at_the_end_stays_one_line_that_the_terminal_breaks() -> None:
    command = "mikasa-vla eval --task RememberColor3-v0 --policy oracle --episodes 20 --out runs/a"
    lines = folded(f"Stopped with 3/24 episodes in runs/a. To resume: {command}", 60).splitlines()
    assert lines == ["Stopped with 3/24 episodes in runs/a. To resume:", command]


def test_indented_lines_and_bars_are_left_alone() -> None:
    text = f"  File {'x ' * 50}\n\r 10%|{'█ ' * 50}\n"
    assert folded(text, 40) == text


def test_messages_are_folded_to_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 60, 0, 0))  # rows, columns, pixels
    with os.fdopen(theirs, "w") as terminal, os.fdopen(ours) as screen:
        monkeypatch.setattr(sys, "stderr", terminal)
        assert main(["eval", "--polcy", "oracle"]) == 1
        monkeypatch.undo()
        assert screen.readline() == "mikasa-vla: error: eval: there is no flag '--polcy'. Did you\n"
        assert screen.readline() == "mean '--policy'? See `mikasa-vla eval --help`.\n"


def test_messages_to_a_file_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "--polcy", "oracle"]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_first_steps_fit_80_columns() -> None:
    assert max(map(len, FIRST_STEPS.splitlines())) <= 80


LISTED = {"kind": [("short", "60 steps", " ".join(["sentence"] * 9)), ("a_longer_name", "9 steps", "one")]}


def test_on_a_terminal_the_last_column_of_a_list_is_folded_below_itself(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "72")
    print_rows(LISTED)
    assert capsys.readouterr().out.splitlines() == [
        "kind:",
        "  short          60 steps  sentence sentence sentence sentence sentence",
        f"{' ' * 27}sentence sentence sentence sentence",
        "  a_longer_name  9 steps   one",
    ]


def test_where_a_terminal_leaves_too_little_room_the_last_column_has_a_line_of_its_own(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "40")
    print_rows(LISTED)
    assert capsys.readouterr().out.splitlines() == [
        "kind:",
        "  short          60 steps",
        "      sentence sentence sentence",
        "      sentence sentence sentence",
        "      sentence sentence sentence",
        "  a_longer_name  9 steps   one",
    ]


def test_in_a_pipe_a_row_of_a_list_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    print_rows(LISTED)
    assert len(capsys.readouterr().out.splitlines()) == 3
