"""Write a comparison as text: Markdown, CSV, JSON, LaTeX or an HTML table."""

import csv
import io
import json
from collections.abc import Sequence

from vla_eval.results.cells import csv_cell, html_table, html_text, markdown_text
from vla_eval.results.estimates import CONFIDENCE
from vla_eval.results.folding import folded
from vla_eval.results.latex import NEEDS, fitted, footnotes, latex_table, latex_text
from vla_eval.results.sweep import Sweep, SweepRow
from vla_eval.results.table_columns import UNDEFINED, sentence_of
from vla_eval.results.table_formats import Format, markdown_table

JSON_VERSION = 1
TEXTS = ("task", "policy", "variant", "95 % interval", "cue frames", "reference")  # the others are numbers
TITLES = (
    *("task", "policy", "K", "variant", "episodes", "success", "95 % interval", "chance", "ceiling"),
    *("cue frames", "reference", "difference", "p", "p (Holm)", "episodes to settle"),
)


SETTINGS = (
    "task",
    "policy",
    "K",
    "variant",
    "episodes",
    "chance",
    "ceiling",
)  # said once if all rows share it
LEFT_OUT_FIRST = (
    *("ceiling", "chance", "p", "cue frames", "episodes", "reference", "episodes to settle", "95 % interval"),
    "variant",
)


def render_sweep(sweep: Sweep, fmt: Format, *, width: int | None = None) -> str:
    """Return the comparison as text, without the notes for CSV.

    Args:
        sweep: what was compared.
        fmt: of the text.
        width: of a terminal, which Markdown is to fit: what all rows share is said above the table, and
            columns that do not fit are left out and named below it.
    """
    titles, rows = sweep_cells(sweep)
    if fmt == "markdown" and width is not None:
        return _on_a_terminal(titles, rows, sweep_notes(sweep), width)
    notes = sweep_notes(sweep)
    is_number = [title not in TEXTS for title in titles]
    if fmt == "csv":
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(
            [titles, *([csv_cell(cell) for cell in row] for row in rows)]
        )
        return text.getvalue().rstrip("\n")
    if fmt == "json":
        return _json(sweep, notes)
    if fmt == "latex":
        return _latex(titles, rows, notes)
    if fmt == "html-table":
        items = [f"<li>{html_text(note)}</li>" for note in notes]
        return "\n".join([html_table(titles, rows, is_number), "<ul>", *items, "</ul>"])
    return f"{markdown_table(titles, rows, is_number)}\n\n" + "\n".join(
        f"- {markdown_text(note)}" for note in notes
    )


def _of_columns(kept: list[str], titles: list[str], rows: list[list[str]]) -> list[list[str]]:
    return [[row[titles.index(title)] for title in kept] for row in rows]


def _on_a_terminal(titles: list[str], rows: list[list[str]], notes: list[str], width: int) -> str:
    found = folded(titles, rows, folds=SETTINGS)
    same, kept = found.same, list(found.titles)
    left_out: list[str] = []
    table = _markdown(kept, found.rows)
    for title in LEFT_OUT_FIRST:
        if len(table.partition("\n")[0]) <= width:
            break
        if title in kept:
            left_out.append(title)
            kept = [one for one in kept if one != title]
            table = _markdown(kept, _of_columns(kept, titles, rows))
    if left_out:
        explained = set(left_out) - {"p"}  # its note is about the corrected p, too
        notes = [note for note in notes if note.partition(":")[0] not in explained]
        notes = [*notes, f"not shown: {', '.join(left_out)} (a pipe or a file gets every column)."]
    above = [sentence_of([(title, markdown_text(cell)) for title, cell in same]), ""] if same else []
    return "\n".join([*above, table, "", *(f"- {markdown_text(note)}" for note in notes)])


def _markdown(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return markdown_table(titles, rows, [title not in TEXTS for title in titles])


def _latex(titles: list[str], rows: list[list[str]], notes: list[str]) -> str:
    """Return a table of the columns that differ, below a line of those that do not, in one line width."""
    same, kept, shown = folded(titles, rows, folds=SETTINGS)
    said = [f"\\noindent{{\\footnotesize {latex_text(sentence_of(same))}\\par}}\\smallskip"] if same else []
    is_number = [title not in TEXTS for title in kept]
    table = fitted(latex_table(kept, shown, is_number, ruled_by_first=kept[0] == "task"))
    return "\n".join([NEEDS, *said, *table, *footnotes(notes)])


def _json(sweep: Sweep, notes: list[str]) -> str:
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
    interval, test = row.measured.interval, row.test
    return {
        **row.key._asdict(),
        "n_episodes": row.n_episodes,
        "success_once": row.measured.success_once,
        "ci_low": interval.low if interval else None,
        "ci_high": interval.high if interval else None,
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
        f"{interval.low:.2f}-{interval.high:.2f}" if interval else UNDEFINED,
        _rate(row.chance.rate if row.chance else None),
        _rate(row.ceiling),
        str(row.cue) if row.cue else UNDEFINED,
        str(getattr(row.reference, sweep.by)) if row.reference else UNDEFINED,
        f"{test.difference:+.2f}" if test else UNDEFINED,
        f"{test.p_value:.3g}" if test else UNDEFINED,
        f"{row.corrected_p:.3g}" if row.corrected_p is not None else UNDEFINED,
        str(row.n_to_settle) if row.n_to_settle is not None else UNDEFINED,
    ]


def _rate(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value:.2f}"
