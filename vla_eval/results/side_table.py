"""A table below the success table, as data: a protocol's figures, published results. Knows no format.

Their rows are never rows of the success table, so that nothing published is mistaken for a measured value.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True, kw_only=True)
class SideTable:
    """A table below the success table.

    Attributes:
        title: a sentence without its full stop.
        titles, rows, is_number: of the columns in formats for reading; without rows only the notes appear.
        notes: whole sentences.
        csv_columns: those that the success table has not.
        csv_rows: column -> value; `source` says that they are not measured episodes.
        json: fields that it adds to the JSON report.
        ruled_by_first: draw a rule wherever the first cell changes.
    """

    title: str
    titles: Sequence[str]
    rows: Sequence[Sequence[str]]
    is_number: Sequence[bool]
    notes: Sequence[str]
    csv_columns: Sequence[str] = ()
    csv_rows: Sequence[Mapping[str, object]] = ()
    json: Mapping[str, object] = field(default_factory=dict)
    ruled_by_first: bool = False
