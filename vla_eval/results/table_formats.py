"""Write a table as Markdown, CSV, JSON, LaTeX or an HTML table. Knows nothing of episodes."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from vla_eval.errors import ReportError
from vla_eval.results.estimates import CONFIDENCE
from vla_eval.results.formats import FOR_READING, Format, Preset
from vla_eval.results.imported.rows import ImportedRow
from vla_eval.results.imported.table import imported_side_table
from vla_eval.results.latex_preset import paper_preset
from vla_eval.results.memory_types import memory_side_tables
from vla_eval.results.own_statistics import mean_text, rate
from vla_eval.results.printed_table import UNDEFINED, Column, SideTable, cells_of, csv_text, write_tables
from vla_eval.results.published.table import paper_side_table, published_side_tables
from vla_eval.results.statistics import column_names
from vla_eval.results.success_table import ProtocolRow, Table
from vla_eval.results.table_columns import lay_out

JSON_VERSION = 1


def render(
    table: Table,
    fmt: Format,
    *,
    paper: bool = False,
    published: str | None = None,
    imported: Sequence[ImportedRow] = (),
    columns: Sequence[str] = (),
    wide: bool = False,
    preset: Preset | None = None,
    width: int | None = None,
) -> str:
    """Write the table; the text has no newline at its end.

    `markdown`, `latex` and `html-table` are for reading: with these columns, or those that fit `width` (None:
    `FITS_CHARACTERS`); `wide`: all of them, and a row per run. `csv` and `json` have every column in full
    precision. The preset `paper` is LaTeX with tasks as columns and policies as rows.
    """
    beside = paper or published is not None or bool(imported)
    check_format(fmt, columns=columns, wide=wide, preset=preset, beside=beside)
    sides = side_tables(table, paper=paper, published=published, imported=imported)
    if preset is not None:
        return paper_preset(table)
    if fmt == "csv":
        names = list(table.rows[0].to_dict()) if table.rows else column_names()
        source = ["source"] if sides else []  # a column, so that they are never confused
        added = dict.fromkeys(name for side in sides for name in side.csv_columns)
        columns = [*source, *names, *(name for name in added if name not in names)]
        measured = ({"source": "measured", **row.to_dict()} for row in table.rows)
        return csv_text(columns, [*measured, *(line for side in sides for line in side.csv_rows)])
    if fmt == "json":
        return _json(table, sides)
    return write_tables([lay_out(table, names=columns, wide=wide, width=width), *sides], fmt)


def render_beside(fmt: Format, *, published: str | None, imported: Sequence[ImportedRow]) -> str:
    """Write published and imported results without measured ones; see `render`."""
    empty = Table(rows=(), notes=(), baselines=(), n_comparisons=0, runs={})
    return render(empty, fmt, published=published, imported=imported)


def check_format(
    fmt: Format, *, columns: Sequence[str], wide: bool, preset: Preset | None, beside: bool
) -> None:
    """Refuse what a format does not have, as `render` does; `beside`: published results are added."""
    if preset is not None and (fmt != "latex" or columns or wide or beside):
        raise ReportError(
            f"--preset {preset} is a whole table in LaTeX, with its own columns. Add --format latex, and "
            "remove --columns, --wide, --paper, --published and --imported."
        )
    if fmt in ("csv", "json") and (columns or wide):
        flag = "--columns" if columns else "--wide"
        raise ReportError(f"{flag}: {fmt} has every column. Remove {flag}, or use {', '.join(FOR_READING)}.")


def side_tables(
    table: Table,
    *,
    paper: bool = False,
    published: str | None = None,
    imported: Sequence[ImportedRow] = (),
) -> list[SideTable]:
    """Return the tables below a success table; arguments as for `render`."""
    return [
        *([protocol_side_table(table)] if table.protocols else []),
        *memory_side_tables(table),
        *([paper_side_table(table)] if paper else []),
        *([imported_side_table(imported)] if imported else []),
        *(published_side_tables(published) if published is not None else []),
    ]


def _json(table: Table, sides: Sequence[SideTable]) -> str:
    data: dict[str, object] = {
        "format_version": JSON_VERSION,
        "confidence": CONFIDENCE,
        "baseline": next(iter(table.baselines), None),
        "baselines": list(table.baselines),
        "n_comparisons": table.n_comparisons,
        "runs": dict(table.runs),
        "rows": [row.to_dict() for row in table.rows],
        "run_rows": [row.to_dict() for row in table.run_rows],
        "notes": list(table.notes),
        "passports": [{**key._asdict(), **one.to_dict()} for key, one in table.passports.items()],
    }
    for side in sides:
        data |= side.json
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False)


NOT_THE_PROTOCOL = "not the protocol"


def protocol_side_table(table: Table) -> SideTable:
    """Return the summary figures of the protocols; a row that departs from its protocol has none."""
    rows = table.protocols
    columns: list[Column[ProtocolRow]] = [
        Column("protocol", lambda row: f"{row.protocol} v{row.version}", is_number=False),
        Column("tasks of", lambda row: row.group or UNDEFINED, is_number=False),
        Column("policy", lambda row: row.policy, is_number=False),
        Column("K", lambda row: str(row.n_action_steps)),
        Column("variant", lambda row: row.variant or UNDEFINED, is_number=False),
        Column("mean", _mean),
        Column("lowest, highest task", _spread),
        Column("runs", lambda row: str(row.n_runs)),
        Column("departs from the protocol", lambda row: "; ".join(row.departures) or "no", is_number=False),
    ]
    whole = SideTable(
        title="Summary figures of protocols: mean of success once over the tasks",
        columns=columns,
        rows=cells_of(columns, rows),
        notes=_protocol_notes(rows),
        csv_columns=("departures",),
        csv_rows=[_csv_row(row) for row in rows],
        json={"protocols": [asdict(row) for row in rows]},
    )
    # The other columns are there even where no row has a value.
    return whole.without(lambda one, cells: one.title in ("tasks of", "variant") and cells == {UNDEFINED})


def _mean(row: ProtocolRow) -> str:
    return NOT_THE_PROTOCOL if row.mean is None else mean_text(row.mean, row.sem, row.ci_low, row.ci_high)


def _spread(row: ProtocolRow) -> str:
    return UNDEFINED if row.mean is None else f"{rate(row.lowest)}, {rate(row.highest)}"


def _protocol_notes(rows: Sequence[ProtocolRow]) -> list[str]:
    kinds = {row.interval for row in rows}
    notes = []
    if "wilson_over_tasks" in kinds:
        notes.append("mean, one run: 95 % interval from the Wilson intervals of the tasks, over episodes.")
    if "t_over_runs" in kinds:
        notes.append("mean, several runs: mean of the run means ± SEM, 95 % t interval over the run means.")
    if any(row.departures for row in rows):
        notes.append(f"{NOT_THE_PROTOCOL}: no summary figure, because something departs from the protocol.")
    return notes


def _csv_row(row: ProtocolRow) -> dict[str, Any]:  # Any: numbers and texts
    return {
        **asdict(row),
        "source": f"protocol {row.protocol} v{row.version}",
        "task": f"mean of {row.n_tasks} tasks" + (f" ({row.group})" if row.group else ""),
        "success_once": row.mean,
        "departures": "; ".join(row.departures),
    }
