"""Choose the columns of the printed table: what is constant goes above it, the rest fits a screen."""

from collections.abc import Sequence
from dataclasses import replace

from vla_eval.errors import check_names, some_of
from vla_eval.results.printed_table import UNDEFINED, Column, PrintedTable, cells_of
from vla_eval.results.statistics import printed_columns
from vla_eval.results.success_table import Row, Table

FITS_CHARACTERS = 100  # width of a terminal that the printed table fits into
CELL_FRAME = len(" | ")  # of Markdown, per column; the table has one more character at its end


def lay_out(
    table: Table, *, names: Sequence[str] = (), wide: bool = False, width: int | None = None
) -> PrintedTable:
    """Choose the columns for reading: exactly these names, in this order; or those that fit `width`.

    The default width is `FITS_CHARACTERS`. `wide`: all but the extra columns, however wide the table becomes
    and whatever is constant, and a row for each of several runs.
    """
    by_name = printed_columns(table.baselines)
    check_names("column", names, by_name, where="--columns")
    if names:
        return _printed(table, [by_name[name] for name in names], table.rows)

    def is_empty(column: Column[Row]) -> bool:
        return column.name != "success" and {column.cell(row) for row in table.rows} == {UNDEFINED}

    shown = [one for one in by_name.values() if not one.is_extra and not is_empty(one)]
    if wide:
        return _printed(table, shown, table.with_runs())
    same = [one for one in shown if one.folds and len(set(map(one.cell, table.rows))) == 1]
    fitting, left_out = _fit(
        [one for one in shown if one not in same], table.rows, width=width or FITS_CHARACTERS
    )
    found = _printed(table, fitting, table.rows)
    if left_out and table.rows:
        text = f"not shown: {some_of(one.title for one in left_out)} (`--wide` shows every column)."
        found = replace(found, notes=(*found.notes, text))
    return replace(found, same=tuple((one.title, one.cell(table.rows[0])) for one in same))


def _printed(table: Table, columns: Sequence[Column[Row]], rows: Sequence[Row]) -> PrintedTable:
    return PrintedTable(columns=columns, rows=cells_of(columns, rows), notes=table.notes)


def _fit(
    columns: Sequence[Column[Row]], rows: Sequence[Row], *, width: int
) -> tuple[list[Column[Row]], list[Column[Row]]]:
    """Return the columns that fit side by side, the most important ones first chosen, and the others."""
    left = width - 1
    kept: set[str] = set()
    for column in sorted(columns, key=lambda one: one.rank):
        own = max(2, len(column.title), *map(len, map(column.cell, rows))) + CELL_FRAME
        if not column.rank or own <= left:
            kept.add(column.name)
            left -= own
    return [one for one in columns if one.name in kept], [one for one in columns if one.name not in kept]
