"""Choose the columns of the printed table: what is constant goes into a line above, the rest fits a screen.

Knows nothing of episodes or of formats.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from vla_eval.errors import check_names
from vla_eval.results.success_table import Row, RunRow, Table

UNDEFINED = "—"
SMALLEST_SHOWN_P = 0.001
FITS_CHARACTERS = 100  # width of a terminal that the printed table fits into
CELL_FRAME = len(" | ")  # of Markdown, per column; the table has one more character at its end


class Column(NamedTuple):
    """One column of the printed table; `--columns` uses its name.

    Attributes:
        rank: columns are left out from the highest rank on if the table would be too wide; 0: never.
        folds: whether it goes into the line above if it has the same cell in all rows.
        is_extra: shown only if it is named.
    """

    name: str
    title: str
    cell: Callable[[Row], str]
    is_number: bool = True
    rank: int = 0
    folds: bool = False
    is_extra: bool = False


class Layout(NamedTuple):
    """What is printed of a table.

    Attributes:
        columns: from the left.
        cells: of each row.
        same: title and cell of each column that has the same cell in all rows.
        left_out: titles of the columns for which there was no room.
    """

    columns: tuple[Column, ...]
    cells: tuple[tuple[str, ...], ...]
    same: tuple[tuple[str, str], ...] = ()
    left_out: tuple[str, ...] = ()


def lay_out(
    table: Table, *, names: Sequence[str] = (), wide: bool = False, width: int | None = None
) -> Layout:
    """Choose the columns for reading.

    Args:
        table: what `build_table` returned.
        names: exactly these columns, in this order.
        wide: all but the extra columns, however wide the table becomes and whatever is constant, and a row
            for each of several runs.
        width: characters that the columns have to fit into, if neither of the two is given; None:
            `FITS_CHARACTERS`.

    Raises:
        UnknownNameError: there is no such column.
    """
    by_name = {column.name: column for column in _columns(table)}
    check_names("column", names, by_name, where="--columns")
    if names:
        return _layout(table, [by_name[name] for name in names])
    shown = [column for column in by_name.values() if not column.is_extra and not _is_empty(column, table)]
    if wide:
        return _layout(table, shown, rows=table.with_runs())
    same = [column for column in shown if column.folds and len(set(_cells(column, table))) == 1]
    varying = [column for column in shown if column not in same]
    fitting, left_out = _fit(varying, table, width=width or FITS_CHARACTERS)
    found = tuple((column.title, column.cell(table.rows[0])) for column in same)
    return _layout(table, fitting)._replace(same=found, left_out=tuple(one.title for one in left_out))


def sentence_of(same: Sequence[tuple[str, str]]) -> str:
    """Return the line above the table, for names that need no escaping or are escaped already."""
    return f"All rows: {', '.join(f'{title} {cell}' for title, cell in same)}."


def _layout(table: Table, columns: Sequence[Column], *, rows: Sequence[Row] | None = None) -> Layout:
    shown = table.rows if rows is None else rows
    return Layout(tuple(columns), tuple(tuple(one.cell(row) for one in columns) for row in shown))


def _fit(columns: Sequence[Column], table: Table, *, width: int) -> tuple[list[Column], list[Column]]:
    """Return the columns that fit side by side, the most important ones first chosen, and the others."""
    left = width - 1
    kept: set[str] = set()
    for column in sorted(columns, key=lambda one: one.rank):
        own = max(2, len(column.title), *map(len, _cells(column, table))) + CELL_FRAME
        if not column.rank or own <= left:
            kept.add(column.name)
            left -= own
    return [one for one in columns if one.name in kept], [one for one in columns if one.name not in kept]


def _cells(column: Column, table: Table) -> Iterator[str]:
    return (column.cell(row) for row in table.rows)


def _is_empty(column: Column, table: Table) -> bool:
    return column.name != "success" and set(_cells(column, table)) == {UNDEFINED}


def _columns(table: Table) -> list[Column]:
    first, second = (*table.baselines, "baseline", "second baseline")[:2]
    return [
        Column("task", "task", lambda row: row.task, is_number=False, folds=True),
        Column("policy", "policy", _policy, is_number=False),
        Column("K", "K", lambda row: str(row.n_action_steps), folds=True),
        Column("variant", "variant", lambda row: row.variant or UNDEFINED, is_number=False),
        Column("success", "success once", _success_once),
        Column("difference", f"vs {first}", lambda row: _difference(row.paired_difference, row.paired_p)),
        Column(
            "second_difference",
            f"vs {second}",
            lambda row: _difference(row.second_difference, row.second_p),
            rank=1,
        ),
        Column("first_choice", "1st choice", lambda row: rate(row.first_choice_success), rank=2),
        Column("chose", "chose", lambda row: _number(row.n_chose), is_extra=True),
        Column("right_if_chose", "right if chose", _right_if_chose, is_extra=True),
        Column("chance", "chance", _chance, rank=3, folds=True),
        Column("ceiling", "ceiling", lambda row: rate(row.ceiling), rank=4, folds=True),
        Column("corrected", "corrected", lambda row: rate(row.chance_corrected), rank=5),
        Column("steps", "steps", lambda row: _count(row.mean_success_step), rank=6),
        Column("at_end", "at end", lambda row: rate(row.success_at_end), rank=7),
        Column("inferences", "infer.", lambda row: _count(row.inferences_per_episode), rank=8),
        Column("episodes", "episodes", _episodes, folds=True),
        Column("errors", "errors", lambda row: str(row.n_errors), folds=True),
    ]


def _policy(row: Row) -> str:
    if not isinstance(row, RunRow):
        return row.policy
    copy = f", folder {row.copy + 1}" if row.copy else ""
    return f"{row.policy}, run {row.run}{copy}"


def rate(value: float | None) -> str:
    """Return a rate with two digits, or a dash."""
    return UNDEFINED if value is None else f"{value + 0.0:.2f}".replace("-0.00", "0.00")


def _count(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value:.1f}"


def _number(value: int | None) -> str:
    return UNDEFINED if value is None else str(value)


def _right_if_chose(row: Row) -> str:
    share, low, high = row.right_if_chose, row.right_if_chose_low, row.right_if_chose_high
    return rate(share) if low is None else f"{rate(share)} [{rate(low)}, {rate(high)}]"


def _episodes(row: Row) -> str:
    return f"{row.n_episodes} ({row.n_runs} runs)" if row.n_runs > 1 else str(row.n_episodes)


def _success_once(row: Row) -> str:
    if row.success_once is None:
        return UNDEFINED
    sem = "" if row.sem is None else f" ± {row.sem:.2f}"
    return f"{row.success_once:.2f}{sem} [{rate(row.ci_low)}, {rate(row.ci_high)}]"


def _difference(difference: float | None, p_value: float | None) -> str:
    if difference is None or p_value is None:
        return UNDEFINED
    p = f"p<{SMALLEST_SHOWN_P}" if p_value < SMALLEST_SHOWN_P else f"p={p_value:.3f}"
    return f"{difference:+.2f}".replace("-0.00", "+0.00") + f" ({p})"


def _chance(row: Row) -> str:
    return rate(row.chance) + ("†" if row.chance_source in ("1/N", "catalogue") else "")
