"""Write a comparison as text: Markdown, CSV, JSON, LaTeX or an HTML table."""

import json
from collections.abc import Sequence
from dataclasses import replace

from vla_eval.results.estimates import CONFIDENCE
from vla_eval.results.formats import Format
from vla_eval.results.own_statistics import rate
from vla_eval.results.printed_table import (
    UNDEFINED,
    Column,
    PrintedTable,
    cells_of,
    csv_text,
    markdown_table,
    write_tables,
)
from vla_eval.results.sweep import Sweep, SweepRow

JSON_VERSION = 1


def render_sweep(sweep: Sweep, fmt: Format, *, width: int | None = None) -> str:
    """Return the comparison as text, without the notes for CSV.

    Args:
        sweep: what was compared.
        fmt: of the text.
        width: of a terminal, which Markdown is to fit: what all rows share is said above the table, and
            columns that do not fit are left out and named below it.
    """
    table = sweep_table(sweep)
    if fmt == "json":
        return _json(sweep, table.notes)
    if fmt == "csv":
        rows = [dict(zip(table.titles, row, strict=True)) for row in table.rows]
        return csv_text(table.titles, rows)
    if fmt == "markdown" and width is not None:
        return write_tables([_fitted(table.folded(), width)], fmt)
    if fmt == "latex":
        table = table.folded()
        text = write_tables([table], fmt)
        return text.replace("{\\footnotesize", "\\noindent{\\footnotesize", 1) if table.same else text
    return write_tables([table], fmt)


def sweep_table(sweep: Sweep) -> PrintedTable:
    """Return the table for reading, without columns that are empty: the variant, if there is only one."""
    columns = _columns(sweep)
    table = PrintedTable(columns=columns, rows=cells_of(columns, sweep.rows), notes=_notes(sweep))
    return table.without(lambda _, cells: not any(cells))


def _fitted(table: PrintedTable, width: int) -> PrintedTable:
    """Leave out columns until the table fits, those of the highest rank first, and the notes on them."""
    left_out: list[str] = []
    for column in sorted((one for one in table.columns if one.rank), key=lambda one: -one.rank):
        head = markdown_table(table.titles, table.rows, table.is_number).partition("\n")[0]
        if len(head) <= width:
            break
        left_out.append(column.title)
        table = table.without(lambda one, _: one.title in left_out)
    if not left_out:
        return table
    explained = set(left_out) - {"p"}  # its note is about the corrected p, too
    notes = [note for note in table.notes if note.partition(":")[0] not in explained]
    text = f"not shown: {', '.join(left_out)} (a pipe or a file gets every column)."
    return replace(table, notes=[*notes, text])


def _json(sweep: Sweep, notes: Sequence[str]) -> str:
    """Return every value in full precision; what is undefined is null."""
    data = {
        "format_version": JSON_VERSION,
        "confidence": CONFIDENCE,
        "by": sweep.by,
        "n_comparisons": sweep.n_comparisons,
        "rows": [_values(row, sweep) for row in sweep.rows],
        "notes": notes,
    }
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False)


def _values(row: SweepRow, sweep: Sweep) -> dict[str, object]:
    test = row.test
    return {
        **row.key._asdict(),
        "n_episodes": row.n_episodes,
        "success_once": row.success.success_once,
        "ci_low": row.success.ci_low,
        "ci_high": row.success.ci_high,
        "chance": row.chance.rate if row.chance else None,
        "ceiling": row.ceiling,
        "cue_frames": list(row.cue) if row.cue else None,
        "reference": getattr(row.reference, sweep.by) if row.reference else None,
        "paired_difference": test.difference if test else None,
        "n_pairs": test.n_pairs if test else None,
        "paired_p_raw": test.p_value if test else None,
        "paired_p": row.corrected_p,
        "episodes_to_settle": row.n_to_settle,
    }


def _notes(sweep: Sweep) -> list[str]:
    return [
        f"p: exact McNemar test on the same task, run and seed, two-sided; Holm's correction over all "
        f"{sweep.n_comparisons} comparisons of this table.",
        f"episodes to settle: pairs that detect a difference of {sweep.difference:g} with power 0.8 at level "
        f"{sweep.level:.3g} (0.05 divided by the number of comparisons), for the share of episodes in which "
        "the two differed here.",
        "cue frames: number of frames of the cue that the policy got in an episode. A policy that reads only "
        "the last frame may have forgotten them when it chooses; scripted controls read no images.",
    ]


def _columns(sweep: Sweep) -> list[Column[SweepRow]]:
    return [
        Column("task", lambda row: row.key.task, is_number=False, folds=True),
        Column("policy", lambda row: row.key.policy, is_number=False, folds=True),
        Column("K", lambda row: str(row.key.n_action_steps), folds=True),
        Column("variant", lambda row: row.key.variant or "", is_number=False, folds=True, rank=1),
        Column("episodes", lambda row: str(row.n_episodes), folds=True, rank=5),
        Column("success", lambda row: rate(row.success.success_once)),
        Column("95 % interval", _interval, is_number=False, rank=2),
        Column("chance", lambda row: rate(row.chance.rate if row.chance else None), folds=True, rank=8),
        Column("ceiling", lambda row: rate(row.ceiling), folds=True, rank=9),
        Column("cue frames", lambda row: str(row.cue or UNDEFINED), is_number=False, rank=6),
        Column("reference", lambda row: _reference(row, sweep.by), is_number=False, rank=4),
        Column("difference", lambda row: f"{row.test.difference:+.2f}" if row.test else UNDEFINED),
        Column("p", lambda row: _p(row.test.p_value if row.test else None), rank=7),
        Column("p (Holm)", lambda row: _p(row.corrected_p)),
        Column(
            "episodes to settle",
            lambda row: UNDEFINED if row.n_to_settle is None else str(row.n_to_settle),
            rank=3,
        ),
    ]


def _interval(row: SweepRow) -> str:
    low, high = row.success.ci_low, row.success.ci_high
    return UNDEFINED if low is None or high is None else f"{low:.2f}-{high:.2f}"


def _reference(row: SweepRow, by: str) -> str:
    return str(getattr(row.reference, by)) if row.reference else UNDEFINED


def _p(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value:.3g}"
