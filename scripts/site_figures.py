"""Draw the figure of each table of results when the site is built; a hook of MkDocs.

A table of results has a column *success once* with rates and intervals, as `mikasa-vla report` prints them.
The figure is drawn from what the table says, so that the two cannot differ; in the repository there is the
table alone. It computes no number.
"""

import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple  # Any: MkDocs passes what this hook does not use

from vla_eval.page.charts import Bar, forest

RATE = re.compile(r"(?P<value>\d\.\d\d)(?: ± \d\.\d\d)? \[(?P<low>\d\.\d\d), (?P<high>\d\.\d\d)\]")
NUMBER = re.compile(r"\d\.\d\d")
UNESCAPED_BAR = re.compile(r"(?<!\\)\|")
SUCCESS = "success once"
LABELS = ("task", "policy", "K")
LEAST_ROWS = 2
WIDTH_PX = 500  # with its labels as wide as a column of text


class TableLines(NamedTuple):
    """A table of Markdown: column -> text, for each row, and the lines that it occupies."""

    rows: list[dict[str, str]]
    end: int


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the figure below each table of results of a page."""
    lines = markdown.split("\n")
    for table in reversed(list(tables(lines))):
        figure = drawn(table.rows)
        if figure is not None:
            lines[table.end : table.end] = ["", figure]
    return "\n".join(lines)


def tables(lines: Sequence[str]) -> Iterator[TableLines]:
    """Yield the tables of a page that have the column, outside blocks of code."""
    is_code, start = False, None
    for index, line in enumerate([*lines, ""]):
        is_code ^= line.startswith("```")
        if line.startswith("|") and not is_code:
            start = index if start is None else start
        elif start is not None:
            if SUCCESS in lines[start]:
                header, _, *rows = (_cells(row) for row in lines[start:index])
                yield TableLines([dict(zip(header, row, strict=True)) for row in rows], index)
            start = None


def drawn(rows: Sequence[dict[str, str]]) -> str | None:
    """Return the figure of a table as HTML in one line; None for a table of something else."""
    column = next((name for row in rows[:1] for name in row if name.startswith(SUCCESS)), None)
    if column is None or len(rows) < LEAST_ROWS:
        return None
    rates = [RATE.fullmatch(row[column]) for row in rows]
    told = [name for name in LABELS if name in rows[0] and len({row[name] for row in rows}) > 1]
    groups = list(dict.fromkeys(_group(row) for row in rows))
    bars = [
        Bar(
            label=" ".join(f"K={row[name]}" if name == "K" else row[name] for name in told),
            color=groups.index(_group(row)),
            **{name: float(rate[name]) for name in ("value", "low", "high")},
            chance=_number(row, "chance"),
            ceiling=_number(row, "ceiling"),
        )
        for row, rate in zip(rows, rates, strict=True)
        if rate is not None
    ]
    if len(bars) < len(rows):  # a header with these words, but not what `report` prints
        return None
    caption = f"{column[0].upper()}{column[1:]} with its interval, from the table above"
    marks = [name for name in ("chance", "ceiling") if any(getattr(bar, name) is not None for bar in bars)]
    signs = {"chance": "dashed: chance", "ceiling": "dotted: ceiling"}
    caption = "; ".join([caption, *(signs[name] for name in marks)])
    chart = forest(bars, title=caption, description="The same numbers are in the table.", width_px=WIDTH_PX)
    return f'<figure class="rates">{chart.svg}{chart.narrow}<figcaption>{caption}.</figcaption></figure>'


def _cells(line: str) -> list[str]:
    return [cell.strip(" `") for cell in UNESCAPED_BAR.split(line.strip())[1:-1]]


def _group(row: dict[str, str]) -> str:
    return row.get("policy") or row.get("task", "")


def _number(row: dict[str, str], column: str) -> float | None:
    found = NUMBER.match(row.get(column, ""))
    return float(found[0]) if found else None
