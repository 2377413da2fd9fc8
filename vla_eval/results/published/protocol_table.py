"""Summary figures of protocols as a table below the success table."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from vla_eval.results.own_statistics import mean_text, rate
from vla_eval.results.printed_table import UNDEFINED, Column, SideTable, cells_of
from vla_eval.results.success_table import ProtocolRow, Table

NOT_THE_PROTOCOL = "not the protocol"


def protocol_side_table(table: Table) -> SideTable:
    """Return the summary figures of the protocols; a row that departs from its protocol has none."""
    rows = table.protocols
    columns: list[Column[ProtocolRow]] = [
        Column("protocol", lambda row: f"{row.protocol} v{row.version}", is_number=False),
        Column("tasks of", lambda row: row.group or UNDEFINED, is_number=False),
        Column("policy", lambda row: row.policy, is_number=False),
        Column("K", lambda row: str(row.n_action_steps)),
        Column("variant", lambda row: row.variant or UNDEFINED, is_number=False),
        Column("mean", _mean),
        Column("lowest, highest task", _spread),
        Column("runs", lambda row: str(row.n_runs)),
        Column("departs from the protocol", lambda row: "; ".join(row.departures) or "no", is_number=False),
    ]
    whole = SideTable(
        title="Summary figures of protocols: mean of success once over the tasks",
        columns=columns,
        rows=cells_of(columns, rows),
        notes=_protocol_notes(rows),
        csv_columns=("departures",),
        csv_rows=[_csv_row(row) for row in rows],
        json={"protocols": [asdict(row) for row in rows]},
    )
    # The other columns are there even where no row has a value.
    return whole.without(lambda one, cells: one.title in ("tasks of", "variant") and cells == {UNDEFINED})


def _mean(row: ProtocolRow) -> str:
    return NOT_THE_PROTOCOL if row.mean is None else mean_text(row.mean, row.sem, row.ci_low, row.ci_high)


def _spread(row: ProtocolRow) -> str:
    return UNDEFINED if row.mean is None else f"{rate(row.lowest)}, {rate(row.highest)}"


def _protocol_notes(rows: Sequence[ProtocolRow]) -> list[str]:
    kinds = {row.interval for row in rows}
    notes = []
    if "wilson_over_tasks" in kinds:
        notes.append("mean, one run: 95 % interval from the Wilson intervals of the tasks, over episodes.")
    if "t_over_runs" in kinds:
        notes.append("mean, several runs: mean of the run means ± SEM, 95 % t interval over the run means.")
    if any(row.departures for row in rows):
        notes.append(f"{NOT_THE_PROTOCOL}: no summary figure, because something departs from the protocol.")
    return notes


def _csv_row(row: ProtocolRow) -> dict[str, Any]:  # Any: numbers and texts
    return {
        **asdict(row),
        "source": f"protocol {row.protocol} v{row.version}",
        "task": f"mean of {row.n_tasks} tasks" + (f" ({row.group})" if row.group else ""),
        "success_once": row.mean,
        "departures": "; ".join(row.departures),
    }
