"""Which columns of a table for reading are columns. Knows nothing of what is in them."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

from vla_eval.results.table_columns import UNDEFINED, sentence_of


class Folded(NamedTuple):
    """A table without the columns that need not be columns.

    Attributes:
        same: title and cell of each column that has the same cell in all rows.
        titles, rows: of the other columns that have a value anywhere.
    """

    same: tuple[tuple[str, str], ...]
    titles: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def sentence(self) -> str | None:
        """The line above the table; None if no column has the same cell in all rows."""
        return sentence_of(self.same) if self.same else None


def folded(titles: Sequence[str], rows: Sequence[Sequence[str]], *, folds: Collection[str]) -> Folded:
    """Leave out columns that are empty, and, of several rows, those that are the same in all.

    Args:
        titles: of the columns.
        rows: as many cells each.
        folds: the columns of which one value for all may stand in a line above.
    """
    cells = dict(zip(titles, zip(*rows, strict=True), strict=True))
    found = [title for title in titles if set(cells[title]) != {UNDEFINED}]
    same = {title for title in found if title in folds and len(rows) > 1 and len(set(cells[title])) == 1}
    kept = [title for title in found if title not in same]
    return Folded(
        same=tuple((title, cells[title][0]) for title in titles if title in same),
        titles=tuple(kept),
        rows=tuple(zip(*(cells[title] for title in kept), strict=True)),
    )
