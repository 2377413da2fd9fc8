"""Write a table as Markdown, CSV, JSON or LaTeX. Knows nothing of episodes."""

import csv
import io
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from typing import Literal, NamedTuple, get_args

from vla_eval.errors import ReportError, check_names, one_line
from vla_eval.results import paper_table
from vla_eval.results.cells import csv_cell, markdown_cell, markdown_text
from vla_eval.results.estimates import CONFIDENCE
from vla_eval.results.paper_table import PAPER_TABLE, PaperFigure
from vla_eval.results.success_table import Row, Table

Format = Literal["markdown", "csv", "json", "latex"]
FORMATS: tuple[str, ...] = get_args(Format)

JSON_VERSION = 1
UNDEFINED = "—"
SMALLEST_SHOWN_P = 0.001
PAPER_TITLE = f"The paper's figures, not measured here ({paper_table.PROTOCOL})"


class Column(NamedTuple):
    """One column of the printed table; `--columns` uses its name. An extra one is shown on request."""

    name: str
    title: str
    cell: Callable[[Row], str]
    is_number: bool = True
    is_extra: bool = False


def render(table: Table, fmt: Format, *, paper: bool = False, columns: Sequence[str] = ()) -> str:
    """Write the table.

    Args:
        table: what `build_table` returned.
        fmt: `markdown` and `latex` are for reading, `csv` and `json` have every column in full precision.
        paper: add the paper's results for the same tasks, marked and separate from the measured ones.
        columns: names of the columns in the formats for reading, in this order; none: all but the extra
            ones.

    Returns:
        The text, without a newline at its end.

    Raises:
        UnknownNameError: there is no such column.
        ReportError: columns are selected for a format that has all of them.
    """
    figures = _paper_figures(table) if paper else None
    if fmt == "markdown":
        return _markdown(table, _chosen(table, columns), figures)
    if fmt == "latex":
        return _latex(table, _chosen(table, columns), figures)
    if columns:
        raise ReportError(f"--columns: {fmt} has every column. Remove --columns, or use markdown or latex.")
    return (_csv if fmt == "csv" else _json)(table, figures)


def table_cells(table: Table) -> tuple[list[Column], list[list[str]]]:
    """Return the columns for reading, and each row's cells."""
    columns = _chosen(table, ())
    return columns, [[column.cell(row) for column in columns] for row in table.rows]


def _paper_figures(table: Table) -> list[PaperFigure]:
    tasks = dict.fromkeys(row.task for row in table.rows)
    return [figure for task in tasks for figure in PAPER_TABLE if figure.task == task]


# ------------------------------------------------------------------------------------------ cells


def _chosen(table: Table, names: Sequence[str]) -> list[Column]:
    """Return the columns of these names, or all but the extra ones: `variant` where there are several."""
    by_name = {column.name: column for column in _columns(table)}
    check_names("column", names, by_name, where="--columns")
    if not names and not any(row.variant for row in table.rows):
        del by_name["variant"]
    if not names:
        return [column for column in by_name.values() if not column.is_extra]
    return [by_name[name] for name in names]


def _columns(table: Table) -> list[Column]:
    baseline = f"vs {table.baseline}" if table.baseline else "vs baseline"
    return [
        Column("task", "task", lambda row: row.task, False),
        Column("policy", "policy", lambda row: row.policy, False),
        Column("K", "K", lambda row: str(row.n_action_steps)),
        Column("variant", "variant", lambda row: row.variant or UNDEFINED, False),
        Column("episodes", "episodes", _episodes),
        Column("errors", "errors", lambda row: str(row.n_errors)),
        Column("success", "success once", _success_once),
        Column("at_end", "at end", lambda row: _rate(row.success_at_end)),
        Column("first_choice", "1st choice", lambda row: _rate(row.first_choice_success)),
        Column("chose", "chose", lambda row: _number(row.n_chose), is_extra=True),
        Column("right_if_chose", "right if chose", _right_if_chose, is_extra=True),
        Column("steps", "steps", lambda row: _count(row.mean_success_step)),
        Column("inferences", "infer.", lambda row: _count(row.inferences_per_episode)),
        Column("difference", baseline, _difference),
        Column("chance", "chance", _chance),
        Column("ceiling", "ceiling", lambda row: _rate(row.ceiling)),
        Column("corrected", "corrected", lambda row: _rate(row.chance_corrected)),
    ]


def _rate(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value + 0.0:.2f}".replace("-0.00", "0.00")


def _count(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value:.1f}"


def _number(value: int | None) -> str:
    return UNDEFINED if value is None else str(value)


def _right_if_chose(row: Row) -> str:
    share, low, high = row.right_if_chose, row.right_if_chose_low, row.right_if_chose_high
    return _rate(share) if low is None else f"{_rate(share)} [{_rate(low)}, {_rate(high)}]"


def _episodes(row: Row) -> str:
    return f"{row.n_episodes} ({row.n_runs} runs)" if row.n_runs > 1 else str(row.n_episodes)


def _success_once(row: Row) -> str:
    if row.success_once is None:
        return UNDEFINED
    sem = "" if row.sem is None else f" ± {row.sem:.2f}"
    return f"{row.success_once:.2f}{sem} [{_rate(row.ci_low)}, {_rate(row.ci_high)}]"


def _difference(row: Row) -> str:
    if row.paired_difference is None or row.paired_p is None:
        return UNDEFINED
    p = f"p<{SMALLEST_SHOWN_P}" if row.paired_p < SMALLEST_SHOWN_P else f"p={row.paired_p:.3f}"
    return f"{row.paired_difference:+.2f}".replace("-0.00", "+0.00") + f" ({p})"


def _chance(row: Row) -> str:
    return _rate(row.chance) + ("†" if row.chance_source in ("1/N", "catalogue") else "")


def _paper_cells(figure: PaperFigure) -> list[str]:
    return [
        figure.task,
        figure.model,
        str(figure.n_action_steps),
        f"{figure.success_once:.2f} ± {figure.sem:.2f}",
    ]


PAPER_TITLES = ["task", "model (paper)", "K", "success once (paper)"]
PAPER_IS_NUMBER = [False, False, True, True]
NOT_IN_PAPER = "The paper's table of VLA models has none of these tasks."


# ------------------------------------------------------------------------------------------ formats


def _markdown(table: Table, columns: Sequence[Column], figures: Sequence[PaperFigure] | None) -> str:
    parts = [
        _markdown_table(
            [column.title for column in columns],
            [[column.cell(row) for column in columns] for row in table.rows],
            [column.is_number for column in columns],
        )
    ]
    if table.notes:
        parts.append("\n".join(f"- {markdown_text(note)}" for note in table.notes))
    if figures:
        parts.append(f"**{PAPER_TITLE}**")
        parts.append(_markdown_table(PAPER_TITLES, [_paper_cells(f) for f in figures], PAPER_IS_NUMBER))
        parts.append(f"- Source: {paper_table.SOURCE}.")
    elif figures is not None:
        parts.append(NOT_IN_PAPER)
    return "\n\n".join(parts)


def _markdown_table(titles: list[str], rows: list[list[str]], is_number: list[bool]) -> str:
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


def _csv(table: Table, figures: Sequence[PaperFigure] | None) -> str:
    names = [field.name for field in fields(Row)]
    source = ["source"] if figures is not None else []  # a column, so that the two are never confused
    text = io.StringIO()
    writer = csv.DictWriter(text, [*source, *names], restval="", extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in table.rows:
        cells = {name: csv_cell(value) for name, value in row.to_dict().items()}
        writer.writerow({"source": "measured", **cells})
    for figure in figures or ():
        writer.writerow({"source": "paper", "policy": figure.model, **asdict(figure)})
    return text.getvalue().rstrip("\n")


def _json(table: Table, figures: Sequence[PaperFigure] | None) -> str:
    data: dict[str, object] = {
        "format_version": JSON_VERSION,
        "confidence": CONFIDENCE,
        "baseline": table.baseline,
        "n_comparisons": table.n_comparisons,
        "runs": dict(table.runs),
        "rows": [row.to_dict() for row in table.rows],
        "notes": list(table.notes),
    }
    if figures is not None:
        data["paper"] = {
            "source": paper_table.SOURCE,
            "protocol": paper_table.PROTOCOL,
            "rows": [asdict(figure) for figure in figures],
        }
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False)


# ------------------------------------------------------------------------------------------ LaTeX

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "{": r"\{",
        "}": r"\}",
        "_": r"\_",
        "%": r"\%",
        "&": r"\&",
        "#": r"\#",
        "$": r"\$",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"$<$",
        ">": r"$>$",
        "±": r"$\pm$",
        "×": r"$\times$",
        "†": r"$^\dagger$",
        "π": r"$\pi$",
        "—": "---",
        "“": "``",
        "”": "''",
    }
)


def _latex(table: Table, columns: Sequence[Column], figures: Sequence[PaperFigure] | None) -> str:
    lines = ["% needs \\usepackage{booktabs}"]
    lines += latex_table(
        [column.title for column in columns],
        [[column.cell(row) for column in columns] for row in table.rows],
        [column.is_number for column in columns],
    )
    lines += [f"\\par\\smallskip{{\\footnotesize {latex_text(note)}\\par}}" for note in table.notes]
    if figures:
        lines += ["", f"\\par\\medskip\\textbf{{{latex_text(PAPER_TITLE)}}}\\par\\smallskip"]
        lines += latex_table(PAPER_TITLES, [_paper_cells(f) for f in figures], PAPER_IS_NUMBER)
        lines.append(f"\\par\\smallskip{{\\footnotesize Source: {latex_text(paper_table.SOURCE)}.\\par}}")
    elif figures is not None:
        lines.append(f"\\par\\smallskip{{\\footnotesize {NOT_IN_PAPER}\\par}}")
    return "\n".join(lines)


def latex_table(titles: list[str], rows: list[list[str]], is_number: list[bool]) -> list[str]:
    """Return the lines of a table for the package booktabs, with a rule where the first column changes."""
    lines = [f"\\begin{{tabular}}{{{''.join('r' if number else 'l' for number in is_number)}}}", "\\toprule"]
    lines += [_latex_row(titles), "\\midrule"]
    for above, row in zip((None, *rows), rows, strict=False):
        if above is not None and above[0] != row[0]:
            lines.append("\\midrule")  # a rule between tasks
        lines.append(_latex_row(row))
    return [*lines, "\\bottomrule", "\\end{tabular}"]


def _latex_row(cells: list[str]) -> str:
    row = " & ".join(re.sub("^-(?=[0-9])", "$-$", latex_text(cell)) for cell in cells)
    # The rule or row above would read a bracket or a star as its own argument.
    return f"{'{}' if row.startswith(('[', '*')) else ''}{row} \\\\"


def latex_text(text: str) -> str:
    """Return text as LaTeX shows it, with what is in backticks set as code."""
    parts = [
        part.translate(_LATEX) for part in re.split("`([^`]*)`", one_line(text))
    ]  # every second one was code
    return "".join(f"\\texttt{{{part}}}" if i % 2 else part for i, part in enumerate(parts))
