"""Write the tables of a probe in each format. Knows nothing of what is in them."""

import csv
import io
from collections.abc import Collection, Sequence
from typing import Any, Literal

from vla_eval.probe.retention import Range
from vla_eval.results.cells import csv_cell, html_table, html_text, markdown_text
from vla_eval.results.estimates import Interval
from vla_eval.results.folding import folded
from vla_eval.results.latex import NEEDS, fitted, footnotes, latex_table, latex_text
from vla_eval.results.table_columns import UNDEFINED
from vla_eval.results.table_formats import markdown_table

ProbeFormat = Literal["markdown", "csv", "json", "latex", "html-table"]
ReadableFormat = Literal["markdown", "latex", "html-table"]
JsonRow = dict[str, Any]  # Any: JSON


def shown_table(
    titles: Sequence[str],
    rows: Sequence[Sequence[str]],
    said: Sequence[str],
    fmt: ReadableFormat,
    *,
    text_titles: Collection[str],
    folds: Collection[str],
) -> str:
    """Return a table with sentences below it, without a newline at its end.

    Args:
        titles: of the columns.
        rows: as many cells each.
        said: the sentences.
        fmt: a format for reading.
        text_titles: columns of words, which are aligned to the left.
        folds: columns that may be folded, see `folded`.
    """
    shown = folded(titles, rows, folds=folds)
    is_number = [title not in text_titles for title in shown.titles]
    above = [] if shown.sentence is None else [shown.sentence]
    if fmt == "latex":
        first = [f"{{\\footnotesize {latex_text(line)}\\par}}\\smallskip" for line in above]
        table = fitted(
            latex_table(shown.titles, shown.rows, is_number, ruled_by_first="task" in shown.titles)
        )
        return "\n".join([NEEDS, *first, *table, *footnotes(said)])
    if fmt == "html-table":
        items = [f"<li>{html_text(line)}</li>" for line in said]
        first = [f"<p>{html_text(line)}</p>" for line in above]
        table_text = html_table(shown.titles, shown.rows, is_number)
        return "\n".join([*first, table_text, "<ul>", *items, "</ul>"])
    first = [part for line in above for part in (markdown_text(line), "")]
    table_text = markdown_table(shown.titles, shown.rows, is_number)
    return "\n".join([*first, table_text, "", *(f"- {markdown_text(line)}" for line in said)])


def rows_as_csv(rows: Sequence[JsonRow]) -> str:
    """Return rows with the same keys as CSV; what is undefined is empty, lists are joined by spaces."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(rows[0])
    writer.writerows([[csv_cell(_csv_value(value)) for value in row.values()] for row in rows])
    return text.getvalue().rstrip("\n")


def shown_rate(rate: float, interval: Interval | Range) -> str:
    """Return `0.50 [0.40, 0.60]`; an end that is not known is `—`."""
    low, high = (UNDEFINED if end is None else f"{end:.2f}" for end in interval)
    return f"{rate:.2f} [{low}, {high}]"


def _csv_value(value: object) -> object:
    if isinstance(value, list):
        return " ".join(map(str, value))
    return "" if value is None else value
