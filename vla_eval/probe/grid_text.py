"""The table of a grid in every format, and in words: which drops chunk and phase explain."""

import json
from collections.abc import Sequence

from vla_eval.probe.grid import AXES, CONTROLS, CUE_READER, ORACLE
from vla_eval.probe.grid_table import GridCell, GridPart, GridTable
from vla_eval.probe.text_table import JsonRow, error_notes, rows_as_csv, shown_rate, success_json
from vla_eval.results.formats import Format
from vla_eval.results.own_statistics import rate
from vla_eval.results.printed_table import UNDEFINED, Column, PrintedTable, cells_of, write_tables

GRID_VERSION = 1
MOST_LISTED = 8  # first inferences whose steps fit into a cell


def render_grid(table: GridTable, fmt: Format) -> str:
    """Return the table as text, without a newline at its end."""
    if fmt == "json":
        report = {
            "grid_version": GRID_VERSION,
            "cells": [_json_cell(table, cell) for cell in table.cells],
            "sentences": grid_sentences(table),
            "notes": grid_notes(table),
        }
        return json.dumps(report, indent=2, ensure_ascii=False, allow_nan=False)
    if fmt == "csv":
        return rows_as_csv([_flat(cell, part) for cell in table.cells for part in (None, *cell.parts)])
    return write_tables([printed_grid(table)], fmt)


def printed_grid(table: GridTable) -> PrintedTable:
    """Return the table for reading, with its sentences and notes below it."""
    columns: list[Column[GridCell]] = [
        Column("task", lambda cell: cell.task, is_number=False, folds=True),
        Column("policy", lambda cell: cell.policy, is_number=False, folds=True),
        Column("K", lambda cell: str(cell.n_action_steps)),
        Column("length", _length, is_number=False),
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
        "mode": cell.mode,
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


def _length(cell: GridCell) -> str:
    mode = f", {cell.mode}" if cell.axis == "latency" else ""
    return f"{AXES[cell.axis]} {cell.level}{mode}"


def _frames_seen(cell: GridCell) -> str:
    seen = _range([part.n_seen for part in cell.parts])
    is_known = seen != UNDEFINED and cell.n_cue_frames > 0
    return f"{seen} of {cell.n_cue_frames}" if is_known else UNDEFINED


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


def grid_sentences(table: GridTable) -> list[str]:
    """Return a sentence for each cell in which a policy succeeds less than in its best cell."""
    by_policy: dict[tuple[str, str, str, str], list[GridCell]] = {}
    for cell in table.cells:
        if cell.reference is not None and cell.rate is not None:
            by_policy.setdefault((cell.task, cell.axis, cell.mode, cell.policy), []).append(cell)
    found = []
    for cells in by_policy.values():
        best = max(cells, key=lambda cell: cell.rate or 0.0)
        found += [sentence for cell in cells if (sentence := _sentence(table, cell, best)) is not None]
    return found


def _sentence(table: GridTable, cell: GridCell, best: GridCell) -> str | None:
    now, at_best = table.reference_of(cell), table.reference_of(best)
    if not _is_below(cell, best) or now is None or at_best is None:
        return None
    drop = f"succeeds in {_rate(cell)} at {_where(cell)}, and in {_rate(best)} at {_where(best)}"
    if cell.axis == "latency":
        return f"{cell.policy} on {cell.task} {drop}; {_cause_of_latency(table, cell, best)}."
    rates = f"succeeds in {_rate(now)} and {_rate(at_best)}: chunk and phase"
    if not _is_below(now, at_best):
        said = f"{rates} do not explain the drop"
    elif _is_below(cell, now):
        said = f"{rates} explain a part of the drop, not all of it"
    else:
        said = (
            f"falls, too, from {_rate(at_best)} to {_rate(now)}: chunk and phase alone explain the drop, not "
            "memory"
        )
    same = f"{now.policy}, which has the same inferences and forgets nothing,"
    return f"{cell.policy} on {cell.task} {drop}; {same} {said}."


def _cause_of_latency(table: GridTable, cell: GridCell, best: GridCell) -> str:
    """Say whether slower inferences cost motion or frames of the cue, by controls that forget nothing."""
    falls = {}
    for control in CONTROLS:
        now, at_best = table.of_policy(control, cell), table.of_policy(control, best)
        if now is not None and at_best is not None and _is_below(now, at_best):
            falls[control] = f"from {_rate(at_best)} to {_rate(now)}"
    if ORACLE in falls:
        return f"oracle, which knows all, falls, too, {falls[ORACLE]}: slow inferences cost motion"
    if cell.reference == CUE_READER and CUE_READER in falls:
        return (
            f"cue_reader, which has the same inferences, falls, too, {falls[CUE_READER]}, and oracle does "
            "not: the frames of the cue that no inference fell into explain the drop, not motion"
        )
    return "no control falls there: neither motion nor missed frames of the cue explain the drop"


def _is_below(one: GridCell, other: GridCell) -> bool:
    """Whether the intervals of two rates do not overlap, and the first rate is the lower one."""
    if one.interval is None or other.interval is None:
        return False
    return one.interval.high < other.interval.low


def _where(cell: GridCell) -> str:
    return f"K = {cell.n_action_steps}, {_length(cell)}"


def _rate(cell: GridCell) -> str:
    return "no episode" if cell.rate is None else f"{cell.rate:.2f}"


def grid_notes(table: GridTable) -> list[str]:
    """Return the notes that a reader of the table needs, errors included."""
    found = [
        "Success once, over all first inferences; 95 % intervals (Wilson) count a seed as one episode. cue "
        "frames: how many the policy is given (oracle reads the true state). late: steps of the response "
        "before its first inference, whose actions were chosen before it. Each from the least to the most "
        "over the first inferences."
    ]
    controls = dict.fromkeys(cell.reference for cell in table.cells if cell.reference is not None)
    if controls:
        found.append(
            "Same inferences: cue_reader for a policy that reads only the last frame (it knows what was in "
            "view at its own inferences, and guesses the rest); oracle for one that reads every frame."
        )
    unknown = dict.fromkeys(
        cell.policy for cell in table.cells if any(part.n_seen is None for part in cell.parts)
    )
    found += [f"{name}: no episode has a result, so that what it reads is not known." for name in unknown]
    return [*found, *error_notes(table.n_errors)]
