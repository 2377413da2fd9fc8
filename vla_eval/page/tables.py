"""Tables as the page's templates show them. Knows nothing of results or of HTML."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

UNKNOWN = "—"
LONGEST_WORD = 30  # characters: a cell with more is prose, and may be broken into lines

ColumnKind = Literal["text", "number", "code"]


DARKEST = 0.65
"""Opacity of the most frequent cell of a matrix: text stays legible on it, in light and in dark."""


class MatrixCell(NamedTuple):
    """A count, the opacity (0 to 1), and whether the cell is outlined as right."""

    n: int
    opacity: float
    is_right: bool


def shaded(
    counts: Sequence[Sequence[int]], is_right: Callable[[int, int], bool]
) -> tuple[tuple[MatrixCell, ...], ...]:
    """Return the cells of a matrix of counts, the most frequent one the darkest.

    Args:
        counts: of each row; one of them is above 0.
        is_right: whether the cell of this row and column is outlined as right.
    """
    most = max(map(max, counts))
    return tuple(
        tuple(MatrixCell(n, DARKEST * n / most, is_right(y, x)) for x, n in enumerate(row))
        for y, row in enumerate(counts)
    )


class Column(NamedTuple):
    """A column: its title, and the style of its cells."""

    title: str
    kind: ColumnKind = "text"

    def css_class(self, cell: str) -> str | None:
        """Return the class of one of its cells."""
        if self.kind == "number":
            return "number"
        return "prose" if self.kind == "code" or len(cell) > LONGEST_WORD else None


@dataclass(frozen=True, slots=True, kw_only=True)
class PageTable:
    """A table whose first column names its rows.

    Attributes:
        columns: at least one.
        rows: the cells of each row, as many as there are columns.
        caption: what the table shows, for screen readers.
        row_data: for each row its data as JSON; may be empty.
    """

    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str | None = None
    row_data: tuple[str, ...] = ()


def page_table(
    rows: Sequence[Sequence[str]],
    *,
    text: Sequence[str] = (),
    numbers: Sequence[str] = (),
    code: Sequence[str] = (),
    caption: str | None = None,
) -> PageTable:
    """Return a table with columns of text first, then numbers, then code, by their titles."""
    return PageTable(
        columns=(
            *(Column(title) for title in text),
            *(Column(title, "number") for title in numbers),
            *(Column(title, "code") for title in code),
        ),
        rows=tuple(tuple(row) for row in rows),
        caption=caption,
    )
