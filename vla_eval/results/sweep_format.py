"""Write a comparison as text: Markdown or CSV."""

import csv
import io
from collections.abc import Sequence
from typing import Literal

from vla_eval.results.cells import csv_cell, markdown_cell, markdown_text
from vla_eval.results.sweep import Sweep, SweepRow

SweepFormat = Literal["markdown", "csv"]
UNKNOWN = "—"
TITLES = (
    *("task", "policy", "K", "variant", "episodes", "success", "95 % interval", "chance", "ceiling"),
    *("cue frames", "reference", "difference", "p", "p (Holm)", "episodes to settle"),
)


def render_sweep(sweep: Sweep, fmt: SweepFormat) -> str:
    """Return the comparison as text, without the notes for CSV."""
    titles, rows = sweep_cells(sweep)
    if fmt == "csv":
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(
            [titles, *([csv_cell(cell) for cell in row] for row in rows)]
        )
        return text.getvalue().rstrip("\n")
    return f"{_markdown(titles, rows)}\n\n" + "\n".join(
        f"- {markdown_text(note)}" for note in sweep_notes(sweep)
    )


def sweep_cells(sweep: Sweep) -> tuple[list[str], list[list[str]]]:
    """Return the titles of the columns, and each row's cells."""
    cells = [_cells(row, sweep) for row in sweep.rows]
    # Omit an empty column: the variant, if there is only one.
    kept = [i for i, _ in enumerate(TITLES) if any(row[i] != "" for row in cells)]
    return [TITLES[i] for i in kept], [[row[i] for i in kept] for row in cells]


def sweep_notes(sweep: Sweep) -> list[str]:
    """Return the notes on the columns."""
    return [
        f"p: exact McNemar test on the same task, run and seed, two-sided; Holm's correction over all "
        f"{sweep.n_comparisons} comparisons of this table.",
        f"episodes to settle: pairs that detect a difference of {sweep.difference:g} with power 0.8 at level "
        f"{sweep.level:.3g} (0.05 divided by the number of comparisons), for the share of episodes in which "
        "the two differed here.",
        "cue frames: number of frames of the cue that the policy got in an episode. A policy that reads only "
        "the last frame may have forgotten them when it chooses; scripted controls read no images.",
    ]


def _cells(row: SweepRow, sweep: Sweep) -> list[str]:
    key, measured, test = row.key, row.measured, row.test
    interval = measured.interval
    return [
        key.task,
        key.policy,
        str(key.n_action_steps),
        key.variant or "",
        str(row.n_episodes),
        _rate(measured.success_once),
        f"{interval.low:.2f}-{interval.high:.2f}" if interval else UNKNOWN,
        _rate(row.chance.rate if row.chance else None),
        _rate(row.ceiling),
        str(row.cue) if row.cue else UNKNOWN,
        str(getattr(row.reference, sweep.by)) if row.reference else UNKNOWN,
        f"{test.difference:+.2f}" if test else UNKNOWN,
        f"{test.p_value:.3g}" if test else UNKNOWN,
        f"{row.corrected_p:.3g}" if row.corrected_p is not None else UNKNOWN,
        str(row.n_to_settle) if row.n_to_settle is not None else UNKNOWN,
    ]


def _rate(value: float | None) -> str:
    return UNKNOWN if value is None else f"{value:.2f}"


def _markdown(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    table = [[markdown_cell(cell) for cell in row] for row in (titles, *rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(titles))]

    def line(cells: Sequence[str]) -> str:
        padded = (cell.ljust(width) for cell, width in zip(cells, widths, strict=True))
        return f"| {' | '.join(padded)} |"

    return "\n".join([line(table[0]), line(["-" * width for width in widths]), *map(line, table[1:])])
