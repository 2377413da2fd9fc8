"""Tables for reading: their columns, and how they are written. Knows nothing of what is in them."""

import csv
import io
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Self  # Any: of whatever rows

from vla_eval.results.cells import csv_cell, html_table, html_text, markdown_cell, markdown_text
from vla_eval.results.formats import ReadableFormat
from vla_eval.results.latex import NEEDS, fitted, latex_table, latex_text

UNDEFINED = "—"


def p_text(p_value: float) -> str:
    """Return a p value as a sentence has it: `p = 0.012`, `p < 0.001`."""
    return "p < 0.001" if p_value < 0.001 else f"p = {p_value:.3f}"


@dataclass(frozen=True, slots=True)
class Column[R]:
    """One column of a table for reading."""

    title: str  # above it
    cell: Callable[[R], str]  # of a row
    is_number: bool = True  # aligned to the right
    _: KW_ONLY
    folds: bool = False  # goes into the line above the table if it has the same cell in all rows
    # columns are left out from the highest rank on if the table would be too wide; 0: never
    rank: int = 0
    name: str = ""  # what `--columns` calls it
    is_extra: bool = False  # shown only if it is named
    is_last: bool = False  # at the right end
    is_code: bool = False  # names and messages, which a page sets as code


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintedTable:
    """A table for reading, and its notes."""

    columns: Sequence[Column[Any]]
    rows: Sequence[Sequence[str]]  # as many cells each; without rows only the notes appear
    notes: Sequence[str] = ()  # whole sentences
    # title and cell of each column that has the same cell in all rows, for a line above the table
    same: Sequence[tuple[str, str]] = ()
    title: str = ""  # of a table below another one: a sentence without its full stop

    @property
    def titles(self) -> list[str]:
        """What stands above each column."""
        return [column.title for column in self.columns]

    @property
    def is_number(self) -> list[bool]:
        """Whether each column is aligned to the right."""
        return [column.is_number for column in self.columns]

    @property
    def sentence(self) -> str:
        """The line above the table; empty if no column has the same cell in all rows."""
        return _sentence(self.same) if self.same else ""

    def without(self, is_left_out: Callable[[Column[Any], Collection[str]], bool]) -> Self:
        """Return the table without some columns, chosen by the column and its different cells."""
        kept = [
            i for i, one in enumerate(self.columns) if not is_left_out(one, {row[i] for row in self.rows})
        ]
        return replace(
            self,
            columns=tuple(self.columns[i] for i in kept),
            rows=tuple(tuple(row[i] for i in kept) for row in self.rows),
        )

    def folded(self) -> Self:
        """Return it without columns that are empty, or have the same cell in each of several rows."""
        found = self.without(lambda _, cells: cells == {UNDEFINED})
        if len(found.rows) < 2:
            return found
        cells = zip(found.columns, found.rows[0], zip(*found.rows, strict=True), strict=True)
        same = [(one.title, first) for one, first, own in cells if one.folds and len(set(own)) == 1]
        return replace(found.without(lambda one, own: one.folds and len(own) == 1), same=same)


@dataclass(frozen=True, slots=True, kw_only=True)
class SideTable(PrintedTable):
    """A table below the success table: nothing published is mistaken for a measured value."""

    csv_columns: Sequence[str] = ()  # those that the success table has not
    # column -> value; `source` says that they are not measured episodes
    csv_rows: Sequence[Mapping[str, object]] = ()
    json: Mapping[str, object] = field(default_factory=dict)  # fields that it adds to the JSON report


def cells_of[R](columns: Sequence[Column[R]], rows: Iterable[R]) -> tuple[tuple[str, ...], ...]:
    """Return the cells of each row."""
    return tuple(tuple(column.cell(row) for column in columns) for row in rows)


def write_tables(tables: Sequence[PrintedTable], fmt: ReadableFormat) -> str:
    """Return tables below each other, without a newline at the end."""
    if fmt == "latex":
        return "\n".join([NEEDS, *(line for table in tables for line in _latex(table))])
    parts = _markdown if fmt == "markdown" else _html
    return ("\n\n" if fmt == "markdown" else "\n").join(part for table in tables for part in parts(table))


def csv_text(names: Sequence[str], rows: Iterable[Mapping[str, object]]) -> str:
    """Return rows as CSV, without a newline at the end; a name that a row lacks is an empty cell."""
    text = io.StringIO()
    writer = csv.DictWriter(text, names, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: csv_cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue().rstrip("\n")


def markdown_table(titles: Sequence[str], rows: Sequence[Sequence[str]], is_number: Sequence[bool]) -> str:
    """Return a table of Markdown whose columns are aligned in its source, too."""
    escaped = [[markdown_cell(cell) for cell in row] for row in (titles, *rows)]
    widths = [max(2, *(len(row[i]) for row in escaped)) for i in range(len(titles))]

    def line(cells: list[str]) -> str:
        padded = (
            cell.rjust(width) if number else cell.ljust(width)
            for cell, width, number in zip(cells, widths, is_number, strict=True)
        )
        return f"| {' | '.join(padded)} |"

    rule = [
        "-" * (width - 1) + (":" if number else "-") for width, number in zip(widths, is_number, strict=True)
    ]
    return "\n".join(line(cells) for cells in (escaped[0], rule, *escaped[1:]))


def _sentence(same: Sequence[tuple[str, str]]) -> str:
    return f"All rows: {', '.join(f'{title} {cell}' for title, cell in same)}."


def _markdown(table: PrintedTable) -> list[str]:
    parts = [_sentence([(title, markdown_cell(cell)) for title, cell in table.same])] if table.same else []
    if table.rows:
        parts += [f"**{markdown_text(table.title)}**"] if table.title else []
        parts.append(markdown_table(table.titles, table.rows, table.is_number))
    if table.notes:
        parts.append("\n".join(f"- {markdown_text(note)}" for note in table.notes))
    return parts


def _latex(table: PrintedTable) -> list[str]:
    lines = [f"{{\\footnotesize {latex_text(table.sentence)}\\par}}\\smallskip"] if table.same else []
    if table.rows:
        if table.title:
            lines += ["", f"\\par\\medskip\\textbf{{{latex_text(table.title)}}}\\par\\smallskip"]
        by_task = table.titles[:1] == ["task"]
        lines += fitted(latex_table(table.titles, table.rows, table.is_number, ruled_by_first=by_task))
    return [*lines, *(f"\\par\\smallskip{{\\footnotesize {latex_text(note)}\\par}}" for note in table.notes)]


def _html(table: PrintedTable) -> list[str]:
    parts = [f"<p>{html_text(table.sentence)}</p>"] if table.same else []
    if table.rows:
        parts += [f"<p>{html_text(table.title)}</p>"] if table.title else []
        parts.append(html_table(table.titles, table.rows, table.is_number))
    items = [f"<li>{html_text(note)}</li>" for note in table.notes]
    return [*parts, "<ul>", *items, "</ul>"] if items else parts
