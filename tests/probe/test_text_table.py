"""Tables of probes: what is the same in all rows is said once, and what is empty not at all."""

import pytest

from vla_eval.probe.text_table import shown_table
from vla_eval.results.folding import folded
from vla_eval.results.table_columns import UNDEFINED

TITLES = ("task", "world", "pairs", "left")
ROWS = (("A", "none", "20", UNDEFINED), ("A", "swap 1", "20", UNDEFINED))


def test_columns_that_are_the_same_in_all_rows_stand_above_and_empty_ones_nowhere() -> None:
    shown = folded(TITLES, ROWS, folds=("task", "pairs"))
    assert shown.sentence == "All rows: task A, pairs 20."
    assert (shown.titles, shown.rows) == (("world",), (("none",), ("swap 1",)))


def test_what_may_not_be_folded_stays_and_a_single_row_keeps_its_names() -> None:
    assert folded(TITLES, ROWS, folds=()).titles == ("task", "world", "pairs")
    assert folded(TITLES, ROWS[:1], folds=("task", "pairs")).titles == ("task", "world", "pairs")


@pytest.mark.parametrize(
    ("fmt", "first"),
    [
        ("markdown", "All rows: task A, pairs 20."),
        ("latex", "% needs \\usepackage{booktabs,graphicx}"),
        ("html-table", "<p>All rows: task A, pairs 20.</p>"),
    ],
)
def test_the_line_above_is_in_every_format_for_reading(fmt: str, first: str) -> None:
    text = shown_table(TITLES, ROWS, ["a note"], fmt, text_titles=("task",), folds=("task", "pairs"))  # type: ignore[arg-type]
    assert text.splitlines()[0] == first
    assert "All rows: task A, pairs 20." in text and "a note" in text
