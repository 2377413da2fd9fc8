"""Tables for reading: what is the same in all rows is said once, and what is empty not at all."""

import pytest

from vla_eval.results.printed_table import UNDEFINED, Column, PrintedTable, cells_of, write_tables

Line = tuple[str, str, str, str]
ROWS: tuple[Line, ...] = (("A", "none", "20", UNDEFINED), ("A", "swap 1", "20", UNDEFINED))


def table(*folds: str, rows: tuple[Line, ...] = ROWS) -> PrintedTable:
    columns: list[Column[Line]] = [
        Column(title, lambda row, i=i: row[i], title != "task", folds=title in folds)
        for i, title in enumerate(("task", "world", "pairs", "left"))
    ]
    return PrintedTable(columns=columns, rows=cells_of(columns, rows), notes=["a note"])


def test_columns_that_are_the_same_in_all_rows_stand_above_and_empty_ones_nowhere() -> None:
    shown = table("task", "pairs").folded()
    assert shown.sentence == "All rows: task A, pairs 20."
    assert (shown.titles, shown.rows) == (["world"], (("none",), ("swap 1",)))


def test_what_may_not_be_folded_stays_and_a_single_row_keeps_its_names() -> None:
    assert table().folded().titles == ["task", "world", "pairs"]
    assert table("task", "pairs", rows=ROWS[:1]).folded().titles == ["task", "world", "pairs"]


@pytest.mark.parametrize(
    ("fmt", "first"),
    [
        ("markdown", "All rows: task A, pairs 20."),
        ("latex", "% needs \\usepackage{booktabs,graphicx}"),
        ("html-table", "<p>All rows: task A, pairs 20.</p>"),
    ],
)
def test_the_line_above_is_in_every_format_for_reading(fmt: str, first: str) -> None:
    text = write_tables([table("task", "pairs").folded()], fmt)  # type: ignore[arg-type]
    assert text.splitlines()[0] == first
    assert "All rows: task A, pairs 20." in text and "a note" in text
