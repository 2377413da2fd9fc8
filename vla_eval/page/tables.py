"""Tables and matrices of the page. Knows nothing of results or of HTML."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from vla_eval.results.printed_table import Column, PrintedTable

DARKEST = 0.65
"""Opacity of the most frequent cell of a matrix: text stays legible on it, in light and in dark."""


class MatrixCell(NamedTuple):
    """A count, the opacity (0 to 1), and whether the cell is outlined as right."""

    n: int
    opacity: float
    is_right: bool


class Matrix(NamedTuple):
    """Counts by two choices: the names of rows and columns, and the cells of each row."""

    title: str
    names: tuple[str, ...]
    columns: tuple[str, ...]
    rows: tuple[tuple[MatrixCell, ...], ...]


def shaded(
    counts: Sequence[Sequence[int]], is_right: Callable[[int, int], bool]
) -> tuple[tuple[MatrixCell, ...], ...]:
    """Return the cells of a matrix of counts, of which one is above 0; the most frequent is the darkest."""
    most = max(map(max, counts))
    return tuple(
        tuple(MatrixCell(n, DARKEST * n / most, is_right(y, x)) for x, n in enumerate(row))
        for y, row in enumerate(counts)
    )


def page_table(
    rows: Sequence[Sequence[str]],
    *,
    text: Sequence[str] = (),
    numbers: Sequence[str] = (),
    code: Sequence[str] = (),
) -> PrintedTable:
    """Return a table of these cells, with columns of text first, then numbers, then code, by their titles."""
    columns = [
        *(Column(title, str, False) for title in text),
        *(Column(title, str) for title in numbers),
        *(Column(title, str, False, is_code=True) for title in code),
    ]
    return PrintedTable(columns=columns, rows=rows)
