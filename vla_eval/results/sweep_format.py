"""Write a comparison as text: Markdown, CSV, JSON, LaTeX or an HTML table."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace

from vla_eval.results.comparison import Comparison
from vla_eval.results.estimates import CONFIDENCE
from vla_eval.results.formats import Format
from vla_eval.results.motion_statistics import SMOOTHNESS, TIMING, shown
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
MOTION_NOTES = {
    "held": "held: share of the control steps at which no chunk had an action and the arm held still.",
    "jump": "jump: at borders of chunks, as a multiple of the median step; docs/real_time.md.",
}
"""Column -> what it is."""


def render_sweep(sweep: Sweep, fmt: Format, *, width: int | None = None) -> str:
    """Return the comparison as text; Markdown without the columns that do not fit `width`, named below it."""
    table = sweep_table(sweep)
    if fmt == "json":
        return _json(sweep, table.notes)
    if fmt == "csv":
        return csv_text(table.titles, [dict(zip(table.titles, row, strict=True)) for row in table.rows])
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
    success, one = row.evidence.success, row.comparison
    return {
        **row.key._asdict(),
        "n_episodes": len(row.evidence.episodes.results),
        "success_once": success.success_once,
        "ci_low": success.ci_low,
        "ci_high": success.ci_high,
        "chance": row.evidence.chance.rate if row.evidence.chance else None,
        "ceiling": row.evidence.ceiling,
        "cue_frames": list(row.cue) if row.cue else None,
        "reference": getattr(one.baseline, sweep.by) if one else None,
        "paired_difference": one.test.difference if one else None,
        "n_pairs": one.pairs.n_pairs if one else None,
        "paired_p_raw": one.test.p_value if one else None,
        "paired_p": one.corrected_p if one else None,
        "episodes_to_settle": row.n_to_settle,
        **TIMING.estimate(row.evidence)._asdict(),
        **SMOOTHNESS.estimate(row.evidence)._asdict(),
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
        *(MOTION_NOTES[one.title] for one in _motion_columns(sweep) if one.title in MOTION_NOTES),
    ]


def _columns(sweep: Sweep) -> list[Column[SweepRow]]:
    def compared(cell: Callable[[Comparison], str]) -> Callable[[SweepRow], str]:
        return lambda row: UNDEFINED if row.comparison is None else cell(row.comparison)

    return [
        Column("task", lambda row: row.key.task, is_number=False, folds=True),
        Column("policy", lambda row: row.key.policy, is_number=False, folds=True),
        Column("K", lambda row: str(row.key.n_action_steps), folds=True),
        Column("variant", lambda row: row.key.variant or "", is_number=False, folds=True, rank=1),
        Column("episodes", lambda row: str(len(row.evidence.episodes.results)), folds=True, rank=5),
        Column("success", lambda row: rate(row.evidence.success.success_once)),
        Column("95 % interval", _interval, is_number=False, rank=2),
        Column(
            "chance",
            lambda row: rate(chance.rate if (chance := row.evidence.chance) else None),
            folds=True,
            rank=8,
        ),
        Column("ceiling", lambda row: rate(row.evidence.ceiling), folds=True, rank=9),
        Column("cue frames", lambda row: str(row.cue or UNDEFINED), is_number=False, rank=6),
        Column("reference", compared(lambda one: str(getattr(one.baseline, sweep.by))), False, rank=4),
        Column("difference", compared(lambda one: f"{one.test.difference:+.2f}")),
        Column("p", compared(lambda one: f"{one.test.p_value:.3g}"), rank=7),
        Column("p (Holm)", compared(lambda one: f"{one.corrected_p:.3g}")),
        Column(
            f"episodes to settle ±{sweep.difference:g}",
            lambda row: UNDEFINED if row.n_to_settle is None else str(row.n_to_settle),
            rank=3,
        ),
        *_motion_columns(sweep),
    ]


def _motion_columns(sweep: Sweep) -> list[Column[SweepRow]]:
    """Return how the arm moved, as far as some row has a value; the first to go where it is narrow."""
    timing = [TIMING.estimate(row.evidence) for row in sweep.rows]
    smoothness = [SMOOTHNESS.estimate(row.evidence) for row in sweep.rows]
    values: dict[str, tuple[list[float | None], str]] = {
        "held": ([one.held_share for one in timing], ".2f"),
        "delay": ([one.mean_delay_steps for one in timing], ".1f"),
        "jump": ([one.border_jump for one in smoothness], ".2f"),
        "turn jump": ([one.border_turn_jump for one in smoothness], ".2f"),
        "jerk m/s³": ([one.jerk_m_s3 for one in smoothness], ".1f"),
    }

    def column(rank: int, title: str, of_rows: list[float | None], form: str) -> Column[SweepRow]:
        cells = {row.key: shown(value, form) for row, value in zip(sweep.rows, of_rows, strict=True)}
        return Column(title, lambda row: cells[row.key], rank=rank)

    return [
        column(10 + number, title, of_rows, form)
        for number, (title, (of_rows, form)) in enumerate(values.items())
        if any(of_rows)
    ]


def _interval(row: SweepRow) -> str:
    low, high = row.evidence.success.ci_low, row.evidence.success.ci_high
    return UNDEFINED if low is None or high is None else f"{low:.2f}-{high:.2f}"
