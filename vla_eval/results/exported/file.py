"""Results for other programs: a JSON file with a schema, a row for each figure, its passport within it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any  # JSON

from vla_eval import __version__
from vla_eval.results.passport.fields import FIELDS
from vla_eval.results.success_table import Row, Table

FORMAT, EXPORT_VERSION = "mikasa-vla-results", 1
Json = dict[str, Any]
NUMBER_OR_NULL: Json = {"type": ["number", "null"]}
RATE: Json = {"type": ["number", "null"], "minimum": 0, "maximum": 1}
TEXT: Json = {"type": "string"}
COUNT: Json = {"type": "integer", "minimum": 0}


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportField:
    """One field of a row: its name, also in `report --format json`, its JSON schema, and what it is."""

    name: str
    schema: Mapping[str, Any]
    words: str


ROW_FIELDS: tuple[ExportField, ...] = (
    ExportField(name="task", schema=TEXT, words="id of the task"),
    ExportField(name="policy", schema=TEXT, words="name of the policy in its run"),
    ExportField(
        name="n_action_steps",
        schema={"type": "integer", "minimum": 1},
        words="actions executed per inference",
    ),
    ExportField(
        name="variant",
        schema={"type": ["string", "null"]},
        words="the settings that differ between the runs of the file; null if none do",
    ),
    ExportField(name="n_episodes", schema=COUNT, words="episodes with a result"),
    ExportField(name="n_errors", schema=COUNT, words="episodes that ended in an error, in no rate"),
    ExportField(name="n_runs", schema=COUNT, words="independent runs that the episodes are of"),
    ExportField(
        name="n_success_once",
        schema={"type": ["integer", "null"], "minimum": 0},
        words="episodes in which the success rule held at any step; null for a task without one",
    ),
    ExportField(name="success_once", schema=RATE, words="their share; of several runs, the mean"),
    ExportField(name="ci_low", schema=RATE, words="lower end of its 95 % interval"),
    ExportField(name="ci_high", schema=RATE, words="upper end"),
    ExportField(
        name="interval",
        schema={"enum": ["wilson", "t_over_runs", None]},
        words="`wilson` over episodes, or `t_over_runs`",
    ),
    ExportField(name="chance", schema=RATE, words="success of a perfect arm without memory"),
    ExportField(
        name="chance_source", schema={"type": ["string", "null"]}, words="`cue_blind` as measured, or `1/N`"
    ),
    ExportField(name="ceiling", schema=RATE, words="success of `oracle` at the same K, if it was run"),
    ExportField(name="return_mean", schema=NUMBER_OR_NULL, words="mean return, of tasks with rewards alone"),
)


def export_schema() -> Json:
    """Return the JSON Schema (2020-12) of the file: `docs/results.schema.json`."""
    texts: Json = {"type": ["string", "null", "array"], "items": {"type": ["string", "null"]}}
    passport = {
        "type": "object",
        "description": "How the figure was made. null: unknown; a list: of several run folders.",
        "properties": {one.name: {**texts, "description": one.words} for one in FIELDS},
        "required": [one.name for one in FIELDS],
        "additionalProperties": False,
    }
    row = {
        "type": "object",
        "properties": {
            **{one.name: {**one.schema, "description": one.words} for one in ROW_FIELDS},
            "passport": passport,
        },
        "required": [*(one.name for one in ROW_FIELDS), "passport"],
        "additionalProperties": False,
    }
    properties = {
        "format": {"const": FORMAT},
        "format_version": {"const": EXPORT_VERSION},
        "made_by": {**TEXT, "description": "program and version"},
        "rows": {"type": "array", "items": row},
        "notes": {"type": "array", "items": TEXT, "description": "what to know before the rows are compared"},
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Results of mikasa-vla-eval",
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def export_text(table: Table) -> str:
    """Return the file: measured rows alone."""
    data = {
        "format": FORMAT,
        "format_version": EXPORT_VERSION,
        "made_by": f"mikasa-vla-eval {__version__}",
        "rows": [_row(row, table) for row in table.rows],
        "notes": list(table.notes),
    }
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _row(row: Row, table: Table) -> Json:
    values = row.to_dict()
    return {
        **{one.name: values[one.name] for one in ROW_FIELDS},
        "passport": table.passports[row.key].to_dict(),
    }
