"""Imported results as a table below a success table, marked as such in every format."""

from collections.abc import Sequence

from vla_eval.results.imported.rows import ImportedRow
from vla_eval.results.own_statistics import rate
from vla_eval.results.passport.ranking import APART, standing_letters
from vla_eval.results.printed_table import UNDEFINED, Column, SideTable, cells_of

SOURCE = "imported"


def imported_side_table(rows: Sequence[ImportedRow]) -> SideTable:
    """Return imported rows with intervals from their counts, and the rows that each may be ranked with."""
    letters = dict(zip(map(id, rows), standing_letters([one.passport for one in rows]), strict=True))
    columns: list[Column[ImportedRow]] = [
        Column("program", lambda one: one.program, is_number=False),
        Column("task", lambda one: one.task, is_number=False),
        Column("policy", lambda one: one.policy or UNDEFINED, is_number=False),
        Column("success", _success),
        Column("episodes", lambda one: str(one.n_episodes)),
        Column("errors", lambda one: str(one.n_errors)),
        Column("success rule", lambda one: one.passport.text("success_rule"), is_number=False),
        Column("ranked with", lambda one: letters[id(one)] or APART, is_number=False),
        Column("file", lambda one: one.file, is_number=False),
    ]
    notes = [f"{one.task} of {one.file}: {'; '.join(one.notes)}." for one in rows if one.notes]
    return SideTable(
        title="Imported results, counted by other programs and not measured here",
        columns=columns,
        rows=cells_of(columns, rows),
        notes=[
            "success: counted again from the episodes of each file, with the 95 % Wilson interval; an error "
            "is no failure.",
            f"{APART}: not known to have been measured as another row was; `mikasa-vla passport FILE` says "
            "what is known.",
            *notes,
        ],
        csv_columns=("success", "success_rule", "reference"),
        csv_rows=[_csv_row(one) for one in rows],
        json={"imported": [_json(one) for one in rows]},
    )


def _success(row: ImportedRow) -> str:
    low, high = row.interval
    return f"{rate(row.rate)} [{rate(low)}, {rate(high)}]"


def _csv_row(row: ImportedRow) -> dict[str, object]:
    return {
        "source": f"{SOURCE}: {row.program}",
        "task": row.task,
        "policy": row.policy,
        "n_episodes": row.n_episodes,
        "n_errors": row.n_errors,
        "success": row.rate,  # by the program's own rule, which may be another than success once
        "success_rule": row.passport.values["success_rule"][0],
        "ci_low": row.interval.low,
        "ci_high": row.interval.high,
        "reference": row.file,
    }


def _json(row: ImportedRow) -> dict[str, object]:
    return {
        "program": row.program,
        "file": row.file,
        "task": row.task,
        "policy": row.policy,
        "n_success": row.n_success,
        "n_episodes": row.n_episodes,
        "n_errors": row.n_errors,
        "success": row.rate,
        "ci_low": row.interval.low,
        "ci_high": row.interval.high,
        "passport": row.passport.to_dict(),
        "notes": list(row.notes),
    }
