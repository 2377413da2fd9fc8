"""The table of a probe as Markdown, CSV, JSON, LaTeX or an HTML table."""

import json
from collections.abc import Sequence

from vla_eval.probe.choice_pairs import ChoicePairs
from vla_eval.probe.decoding_text import decoding_json, printed_decoding
from vla_eval.probe.find_worlds import find_probes
from vla_eval.probe.grid_text import render_grid
from vla_eval.probe.mistakes import MISTAKES, Mistakes
from vla_eval.probe.retention import Range
from vla_eval.probe.retention_curves import Retention
from vla_eval.probe.sentences import notes, sentences
from vla_eval.probe.table import ProbeRow, ProbeTable
from vla_eval.probe.text_table import JsonRow, rows_as_csv, shown_rate, success_json
from vla_eval.results.cells import markdown_text
from vla_eval.results.estimates import Interval, Share
from vla_eval.results.formats import Format
from vla_eval.results.own_statistics import rate
from vla_eval.results.printed_table import (
    UNDEFINED,
    Column,
    PrintedTable,
    cells_of,
    markdown_table,
    write_tables,
)
from vla_eval.results.relative_statistics import SMALLEST_SHOWN_P
from vla_eval.storage.run_folder import StoredRun

PROBE_VERSION = 1
HALF_LIFE_STATES = {False: "measured", True: "beyond_longest_delay"}


def render_probe(table: ProbeTable, fmt: Format) -> str:
    """Return the table as text, without a newline at its end."""
    if fmt == "json":
        return json.dumps(probe_json(table), indent=2, ensure_ascii=False, allow_nan=False)
    if fmt == "csv":
        return rows_as_csv([json_row(row) for row in table.rows])
    decoded = [printed_decoding(table.decoded)] if table.decoded else []
    return write_tables([printed_probe(table), *decoded], fmt)


def printed_probe(table: ProbeTable) -> PrintedTable:
    """Return the table for reading, with its sentences and notes below it."""
    cells = cells_of(_COLUMNS, table.rows)
    return PrintedTable(columns=_COLUMNS, rows=cells, notes=[*sentences(table), *notes(table)]).folded()


def probe_json(table: ProbeTable) -> JsonRow:
    """Return rows, retention curves and sentences as JSON; undefined values are null."""
    return {
        "probe_version": PROBE_VERSION,
        "rows": [json_row(row) for row in table.rows],
        "decoded": decoding_json(table.decoded),
        "retention": [_json_retention(curve) for curve in table.retention],
        "sentences": sentences(table),
        "notes": notes(table),
    }


def json_row(row: ProbeRow) -> JsonRow:
    """Return one row; `ci_low` and `ci_high` belong to `success_once`."""
    swap = row.swap
    return {
        "task": row.task,
        "policy": row.policy,
        "n_action_steps": row.n_action_steps,
        "intervention": row.intervention,
        "level": row.level,
        "delay_steps": row.delay_steps,
        "cue_inference_steps": list(row.inferences.cue_steps) if row.inferences else None,
        "n_late_steps": row.inferences.n_late if row.inferences else None,
        "n_pairs": row.n_pairs,
        "change_of": swap.change_of if swap else None,
        **_json_share("sensitivity", swap.sensitivity if swap else None),
        **_json_share("actions_changed", swap.actions_changed if swap else None),
        **_json_share("warranted_choice", swap.warranted_choice if swap else None),
        "matched_world_value": swap.matched_value if swap else None,
        **_ends("matched_world_value", swap.matched_interval if swap else None),
        **_json_share("reliability", swap.reliability if swap else None),
        **_json_share("follows", row.followed),
        **_json_share("follows_memory", row.followed_memory),
        "n_without_choice": row.n_without_choice,
        **success_json(row.success),
        "chance": row.chance,
        "left": row.left[0] if row.left else None,
        **_ends("left", row.left[1] if row.left else None),
        "items_kept": row.kept.n_items if row.kept else None,
        **_ends("items_kept", row.kept.interval if row.kept else None),
        **_json_mistakes(row.mistakes),
        "over_delay": row.over_delay.difference if row.over_delay else None,
        **_ends("over_delay", row.over_delay.interval if row.over_delay else None),
        "p_value": row.p_value,
        "corrected_p": row.corrected_p,
        "n_errors": row.n_errors,
    }


def _json_mistakes(found: Mistakes | None) -> JsonRow:
    return {
        "n_with_touches": found.n_episodes if found else None,
        **{f"n_{kind}_mistakes": found.counts[kind] if found else None for kind in MISTAKES},
        "expected_place_mistakes": found.expected_place if found else None,
        "n_incomplete": found.n_incomplete if found else None,
    }


def _json_share(name: str, share: Share | None) -> JsonRow:
    return {
        f"n_{name}": share.n if share else None,
        name: share.rate if share else None,
        **_ends(name, share.interval if share else None),
    }


def _ends(name: str, interval: Interval | Range | None) -> JsonRow:
    low, high = (None, None) if interval is None else interval
    return {f"{name}_low": low, f"{name}_high": high}


def _json_retention(curve: Retention) -> JsonRow:
    half = curve.half_life
    return {
        "task": curve.task,
        "policy": curve.policy,
        "n_action_steps": curve.n_action_steps,
        "of": curve.of,
        "points": [
            {"delay_steps": point.delay_steps, **_json_share(curve.of, point.share), "chance": point.chance}
            for point in curve.points
        ],
        "half_life_steps": half.steps if half else None,
        **_ends("half_life_steps", half.interval if half else None),
        "half_life_state": "undefined" if half is None else HALF_LIFE_STATES[half.steps is None],
        "longest_delay_steps": curve.points[-1].delay_steps,
    }


def _shown(share: Share | None) -> str:
    return UNDEFINED if share is None else shown_rate(share.rate, share.interval)


def _shown_p(p_value: float | None) -> str:
    if p_value is None:
        return UNDEFINED
    return f"<{SMALLEST_SHOWN_P}" if p_value < SMALLEST_SHOWN_P else f"{p_value:.3f}"


_COLUMNS: tuple[Column[ProbeRow], ...] = (
    Column("task", lambda row: row.task, is_number=False, folds=True),
    Column("policy", lambda row: row.policy, is_number=False, folds=True),
    Column("K", lambda row: str(row.n_action_steps), folds=True),
    Column("world", lambda row: row.label, is_number=False),
    Column("pairs", lambda row: str(row.n_pairs), folds=True),
    Column("sensitivity", lambda row: _shown(row.swap.sensitivity if row.swap else None)),
    Column("warranted", lambda row: _shown(row.swap.warranted_choice if row.swap else None)),
    Column(
        "value",
        lambda row: shown_rate(row.swap.matched_value, row.swap.matched_interval) if row.swap else UNDEFINED,
    ),
    Column("reliable", lambda row: _shown(row.swap.reliability if row.swap else None)),
    Column("follows", lambda row: _shown(row.followed)),
    Column("memory", lambda row: _shown(row.followed_memory)),
    Column("success once", lambda row: _shown(row.success)),
    Column("chance", lambda row: rate(row.chance), folds=True),
    Column("left", lambda row: shown_rate(*row.left) if row.left else UNDEFINED),
    Column("kept", lambda row: shown_rate(*row.kept) if row.kept else UNDEFINED),
    Column("over delay", lambda row: shown_rate(*row.over_delay[1:]) if row.over_delay else UNDEFINED),
    Column("p", lambda row: _shown_p(row.p_value)),
    Column("p (Holm)", lambda row: _shown_p(row.corrected_p)),
)


def probe_texts(runs: Sequence[StoredRun]) -> list[str]:
    """Return Markdown for each probe and each grid among the run folders."""
    texts = []
    for probe in find_probes(runs):
        if probe.worlds:
            matrices = map(_pairs_text, probe.pairs())
            table = render_probe(probe.table(), "markdown")
            doubles = [f"- {markdown_text(note)}" for note in probe.doubles]
            texts.append("\n\n".join([f"**Probe {probe.folder}**", table, *doubles, *matrices]))
        if probe.grid:
            grid = render_grid(probe.grid_table(), "markdown")
            texts.append(f"**Grid {probe.folder}**\n\n{grid}")
    return texts


def _pairs_text(pairs: ChoicePairs) -> str:
    title = (
        f"First choices of {pairs.policy} on {pairs.world.task}, K = {pairs.n_action_steps}: as drawn "
        f"(rows), {pairs.world.label} (columns)"
    )
    indices = range(len(pairs.names))
    counts = [[str(pairs.counts.get((row, column), 0)) for column in indices] for row in indices]
    rows = [[name, *own] for name, own in zip(pairs.names, counts, strict=True)]
    table = markdown_table(("drawn ↓ other →", *pairs.names), rows, [False, *(True for _ in indices)])
    return f"{title}\n\n{table}"
