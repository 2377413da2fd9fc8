"""What is printed fits the terminal; what goes to a pipe or a file is not broken into lines."""

import sys

import pytest

from vla_eval.cli.screen import print_markdown, screen_width, wrapped

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
