"""The table of a grid as Markdown, CSV, JSON, LaTeX or an HTML table."""

import json
from collections.abc import Sequence

from vla_eval.probe.grid_sentences import grid_notes, grid_sentences
from vla_eval.probe.grid_table import GridCell, GridPart, GridTable
from vla_eval.probe.text_table import JsonRow, rows_as_csv, shown_rate, success_json
from vla_eval.results.formats import Format
from vla_eval.results.own_statistics import rate
from vla_eval.results.printed_table import UNDEFINED, Column, PrintedTable, cells_of, write_tables

GRID_VERSION = 1
MOST_LISTED = 8  # first inferences whose steps fit into a cell


def render_grid(table: GridTable, fmt: Format) -> str:
    """Return the table as text, without a newline at its end."""
    if fmt == "json":
        return json.dumps(grid_json(table), indent=2, ensure_ascii=False, allow_nan=False)
    if fmt == "csv":
        return rows_as_csv([_flat(cell, part) for cell in table.cells for part in (None, *cell.parts)])
    return write_tables([printed_grid(table)], fmt)


def printed_grid(table: GridTable) -> PrintedTable:
    """Return the table for reading, with its sentences and notes below it."""
    columns: list[Column[GridCell]] = [
        Column("task", lambda cell: cell.task, is_number=False, folds=True),
        Column("policy", lambda cell: cell.policy, is_number=False, folds=True),
        Column("K", lambda cell: str(cell.n_action_steps)),
        Column("length", lambda cell: f"{cell.axis} {cell.level}", is_number=False),
        Column("first inference", lambda cell: _range([part.first_inference_step for part in cell.parts])),
        Column("inferences in the cue", lambda cell: _steps_of(cell.parts), is_number=False),
        Column("cue frames", _frames_seen),
        Column("late", lambda cell: _range([part.inferences.n_late for part in cell.parts])),
        Column("success once", _shown),
        Column("lowest, highest", _spread),
        Column("same inferences", lambda cell: _shown(table.reference_of(cell))),
        Column("chance", lambda cell: rate(cell.chance), folds=True),
    ]
    said = [*grid_sentences(table), *grid_notes(table)]
    return PrintedTable(columns=columns, rows=cells_of(columns, table.cells), notes=said).folded()


def grid_json(table: GridTable) -> JsonRow:
    """Return cells and sentences as JSON; undefined values are null."""
    return {
        "grid_version": GRID_VERSION,
        "cells": [_json_cell(table, cell) for cell in table.cells],
        "sentences": grid_sentences(table),
        "notes": grid_notes(table),
    }


def _json_cell(table: GridTable, cell: GridCell) -> JsonRow:
    reference = table.reference_of(cell)
    return {
        **_key(cell),
        "n_cue_frames": cell.n_cue_frames,
        "n_seeds": cell.n_seeds,
        "success_once": cell.rate,
        "ci_low": cell.interval.low if cell.interval else None,
        "ci_high": cell.interval.high if cell.interval else None,
        "reference": cell.reference,
        "reference_success_once": reference.rate if reference else None,
        "chance": cell.chance,
        "n_errors": cell.n_errors,
        "first_inferences": [_json_part(part) for part in cell.parts],
    }


def _key(cell: GridCell) -> JsonRow:
    return {
        "task": cell.task,
        "policy": cell.policy,
        "n_action_steps": cell.n_action_steps,
        "phase": cell.axis,
        "length_steps": cell.level,
    }


def _json_part(part: GridPart) -> JsonRow:
    success, followed = part.success, part.followed
    return {
        "first_inference_step": part.first_inference_step,
        "cue_inference_steps": list(part.inferences.cue_steps),
        "n_cue_frames_seen": part.n_seen,
        "n_late_steps": part.inferences.n_late,
        "n_episodes": success.of if success else 0,
        **success_json(success),
        "n_follows": followed.n if followed else None,
        "n_errors": part.n_errors,
    }


def _flat(cell: GridCell, part: GridPart | None) -> JsonRow:
    """Return a row of CSV: the whole cell, whose first inference is empty, or one first inference of it."""
    if part is None:
        known = [one.success for one in cell.parts if one.success is not None]
        followed = [one.followed for one in cell.parts if one.followed is not None]
        own: JsonRow = {
            **dict.fromkeys(_json_part(cell.parts[0])),
            "n_episodes": sum(one.of for one in known),
            "n_success_once": sum(one.n for one in known) if known else None,
            "success_once": cell.rate,
            "ci_low": cell.interval.low if cell.interval else None,
            "ci_high": cell.interval.high if cell.interval else None,
            "n_follows": sum(one.n for one in followed) if followed else None,
            "n_errors": cell.n_errors,
        }
    else:
        own = _json_part(part)
    return {**_key(cell), **own, "n_cue_frames": cell.n_cue_frames, "chance": cell.chance}


def _frames_seen(cell: GridCell) -> str:
    seen = _range([part.n_seen for part in cell.parts])
    return UNDEFINED if seen == UNDEFINED else f"{seen} of {cell.n_cue_frames}"


def _spread(cell: GridCell) -> str:
    rates = [part.success.rate for part in cell.parts if part.success is not None]
    return f"{min(rates):.2f}, {max(rates):.2f}" if len(rates) > 1 else UNDEFINED


def _shown(cell: GridCell | None) -> str:
    if cell is None or cell.rate is None or cell.interval is None:
        return UNDEFINED
    return shown_rate(cell.rate, cell.interval)


def _range(values: Sequence[int | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return UNDEFINED
    least, most = min(known), max(known)
    return str(least) if least == most else f"{least} to {most}"


def _steps_of(parts: Sequence[GridPart]) -> str:
    """Return the steps of the cue with an inference, for each first inference: `0, 4; 1; 2; 3; none`."""
    listed = [", ".join(map(str, part.inferences.cue_steps)) or "none" for part in parts[:MOST_LISTED]]
    return "; ".join([*listed, *(["…"] if len(parts) > MOST_LISTED else [])])
