"""Write a table as Markdown, CSV, JSON, LaTeX or an HTML table. Knows nothing of episodes."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Literal, get_args

from vla_eval.errors import ReportError, some_of
from vla_eval.results.cells import csv_cell, html_table, html_text, markdown_cell, markdown_text
from vla_eval.results.estimates import CONFIDENCE
from vla_eval.results.latex import NEEDS, fitted, footnotes, latex_table, latex_text
from vla_eval.results.latex_preset import paper_preset
from vla_eval.results.published.protocol_table import protocol_side_table
from vla_eval.results.published.table import paper_side_table, published_side_tables
from vla_eval.results.side_table import SideTable
from vla_eval.results.success_table import Row, Table
from vla_eval.results.table_columns import Layout, lay_out, sentence_of

Format = Literal["markdown", "csv", "json", "latex", "html-table"]
FORMATS: tuple[str, ...] = get_args(Format)
Preset = Literal["paper"]
PRESETS: tuple[str, ...] = get_args(Preset)
FOR_READING = ("markdown", "latex", "html-table")

JSON_VERSION = 1


def render(
    table: Table,
    fmt: Format,
    *,
    paper: bool = False,
    published: str | None = None,
    columns: Sequence[str] = (),
    wide: bool = False,
    preset: Preset | None = None,
    width: int | None = None,
) -> str:
    """Write the table.

    Args:
        table: what `build_table` returned.
        fmt: `markdown`, `latex` and `html-table` are for reading, `csv` and `json` have every column in full
            precision.
        paper: add the paper's results for the same tasks, marked and separate from the measured ones.
        published: add the published results of this board, marked and separate from the measured ones.
        columns: names of the columns in the formats for reading, in this order; none: those that fit.
        wide: all columns in the formats for reading, however wide the table becomes, and a row per run.
        preset: `paper`: LaTeX with tasks as columns and policies as rows.
        width: characters that the chosen columns have to fit into; None: `FITS_CHARACTERS`.

    Returns:
        The text, without a newline at its end.

    Raises:
        UnknownNameError: there is no such column or board.
        ReportError: columns are selected for a format that has all of them, or a preset that it has not.
    """
    check_format(fmt, columns=columns, wide=wide, preset=preset, beside=paper or published is not None)
    sides = side_tables(table, paper=paper, published=published)
    if preset is not None:
        return paper_preset(table)
    if fmt == "csv":
        return _csv(table, sides)
    if fmt == "json":
        return _json(table, sides)
    layout = lay_out(table, names=columns, wide=wide, width=width)
    return {"markdown": _markdown, "latex": _latex, "html-table": _html}[fmt](table, layout, sides)


def render_published(board: str, fmt: Format) -> str:
    """Write the published results of a board without measured ones; see `render`."""
    empty = Table(rows=(), notes=(), baselines=(), n_comparisons=0, runs={})
    return render(empty, fmt, published=board)


def check_format(
    fmt: Format, *, columns: Sequence[str], wide: bool, preset: Preset | None, beside: bool
) -> None:
    """Refuse what a format does not have; arguments as for `render`, `beside`: published results are added.

    Raises:
        ReportError: columns are selected for a format that has all of them, or a preset that it has not.
    """
    if preset is not None and (fmt != "latex" or columns or wide or beside):
        raise ReportError(
            f"--preset {preset} is a whole table in LaTeX, with its own columns. Add --format latex, and "
            "remove --columns, --wide, --paper and --published."
        )
    if fmt in ("csv", "json") and (columns or wide):
        flag = "--columns" if columns else "--wide"
        raise ReportError(f"{flag}: {fmt} has every column. Remove {flag}, or use {', '.join(FOR_READING)}.")


def side_tables(table: Table, *, paper: bool = False, published: str | None = None) -> list[SideTable]:
    """Return the tables below a success table; arguments as for `render`."""
    return [
        *([protocol_side_table(table)] if table.protocols else []),
        *([paper_side_table(table)] if paper else []),
        *(published_side_tables(published) if published is not None else []),
    ]


def _notes(table: Table, layout: Layout) -> list[str]:
    """Return the notes of the table, and which columns it lacks."""
    if not layout.left_out or not table.rows:
        return list(table.notes)
    return [*table.notes, f"not shown: {some_of(layout.left_out)} (`--wide` shows every column)."]


def _titles(layout: Layout) -> list[str]:
    return [column.title for column in layout.columns]


def _is_number(layout: Layout) -> list[bool]:
    return [column.is_number for column in layout.columns]


# ------------------------------------------------------------------------------------------ formats


def _markdown(table: Table, layout: Layout, sides: Sequence[SideTable]) -> str:
    parts = []
    if layout.same:
        parts.append(sentence_of([(title, markdown_cell(cell)) for title, cell in layout.same]))
    if table.rows:
        parts.append(markdown_table(_titles(layout), layout.cells, _is_number(layout)))
    if notes := _notes(table, layout):
        parts.append("\n".join(f"- {markdown_text(note)}" for note in notes))
    parts += [markdown_side_table(side) for side in sides]
    return "\n\n".join(parts)


def markdown_side_table(side: SideTable) -> str:
    """Return a table below the success table: title, table, notes."""
    parts = []
    if side.rows:
        parts.append(f"**{markdown_text(side.title)}**")
        parts.append(markdown_table(side.titles, side.rows, side.is_number))
    if side.notes:
        parts.append("\n".join(f"- {markdown_text(note)}" for note in side.notes))
    return "\n\n".join(parts)


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


def _csv(table: Table, sides: Sequence[SideTable]) -> str:
    names = [field.name for field in fields(Row)]
    source = ["source"] if sides else []  # a column, so that they are never confused
    added = dict.fromkeys(name for side in sides for name in side.csv_columns)
    text = io.StringIO()
    columns = [*source, *names, *(name for name in added if name not in names)]
    writer = csv.DictWriter(text, columns, restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in table.rows:
        writer.writerow({"source": "measured", **_csv_cells(row.to_dict())})
    for side in sides:
        writer.writerows(_csv_cells(line) for line in side.csv_rows)
    return text.getvalue().rstrip("\n")


def _csv_cells(values: Mapping[str, object]) -> dict[str, object]:
    return {name: csv_cell(value) for name, value in values.items()}


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
    }
    for side in sides:
        data |= side.json
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False)


def _latex(table: Table, layout: Layout, sides: Sequence[SideTable]) -> str:
    lines = [NEEDS]
    if layout.same:
        lines.append(f"{{\\footnotesize {latex_text(sentence_of(layout.same))}\\par}}\\smallskip")
    by_task = layout.columns[0].name == "task"
    if table.rows:
        lines += fitted(
            latex_table(_titles(layout), layout.cells, _is_number(layout), ruled_by_first=by_task)
        )
    lines += footnotes(_notes(table, layout))
    for side in sides:
        if side.rows:
            lines += ["", f"\\par\\medskip\\textbf{{{latex_text(side.title)}}}\\par\\smallskip"]
            lines += fitted(
                latex_table(side.titles, side.rows, side.is_number, ruled_by_first=side.ruled_by_first)
            )
        lines += footnotes(side.notes)
    return "\n".join(lines)


def _html(table: Table, layout: Layout, sides: Sequence[SideTable]) -> str:
    parts = [f"<p>{html_text(sentence_of(layout.same))}</p>"] if layout.same else []
    if table.rows:
        parts.append(html_table(_titles(layout), layout.cells, _is_number(layout)))
    parts += _html_notes(_notes(table, layout))
    for side in sides:
        if side.rows:
            parts += [f"<p>{html_text(side.title)}</p>", html_table(side.titles, side.rows, side.is_number)]
        parts += _html_notes(side.notes)
    return "\n".join(parts)


def _html_notes(notes: Sequence[str]) -> list[str]:
    return ["\n".join(["<ul>", *(f"<li>{html_text(note)}</li>" for note in notes), "</ul>"])] if notes else []
