"""Tables below the success table: a protocol's summary figures, the paper's results. Knows no format.

They are never rows of the success table, so that nothing published is mistaken for a measured value.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from vla_eval.results import paper_table
from vla_eval.results.paper_table import PAPER_TABLE
from vla_eval.results.success_table import ProtocolRow, Table
from vla_eval.results.table_columns import UNDEFINED, rate

NOT_THE_PROTOCOL = "not the protocol"


@dataclass(frozen=True, slots=True, kw_only=True)
class SideTable:
    """A table below the success table.

    Attributes:
        title: a sentence without its full stop.
        titles, rows, is_number: of the columns in formats for reading; without rows only the notes appear.
        notes: whole sentences.
        csv_columns: those that the success table has not.
        csv_rows: column -> value; `source` says that they are not measured episodes.
        json_name, json_value: the field of the JSON report.
        ruled_by_first: draw a rule wherever the first cell changes.
    """

    title: str
    titles: Sequence[str]
    rows: Sequence[Sequence[str]]
    is_number: Sequence[bool]
    notes: Sequence[str]
    csv_rows: Sequence[Mapping[str, object]]
    json_name: str
    json_value: object
    csv_columns: Sequence[str] = ()
    ruled_by_first: bool = False


def side_tables(table: Table, *, paper: bool = False) -> list[SideTable]:
    """Return the tables below a success table.

    Args:
        table: what `build_table` returned.
        paper: the paper's results for the same tasks are one of them.
    """
    return [
        *([protocol_side_table(table)] if table.protocols else []),
        *([paper_side_table(table)] if paper else []),
    ]


def paper_side_table(table: Table) -> SideTable:
    """Return the paper's results for the tasks of a table."""
    tasks = dict.fromkeys(row.task for row in table.rows)
    figures = [figure for task in tasks for figure in PAPER_TABLE if figure.task == task]
    return SideTable(
        title=f"The paper's figures, not measured here ({paper_table.PROTOCOL})",
        titles=["task", "model (paper)", "K", "success once (paper)"],
        rows=[
            [one.task, one.model, str(one.n_action_steps), f"{one.success_once:.2f} ± {one.sem:.2f}"]
            for one in figures
        ],
        is_number=[False, False, True, True],
        notes=[
            f"Source: {paper_table.SOURCE}."
            if figures
            else "The paper's table of VLA models has none of these tasks."
        ],
        csv_rows=[{"source": "paper", "policy": one.model, **asdict(one)} for one in figures],
        json_name="paper",
        json_value={
            "source": paper_table.SOURCE,
            "protocol": paper_table.PROTOCOL,
            "rows": [asdict(figure) for figure in figures],
        },
        ruled_by_first=True,
    )


def protocol_side_table(table: Table) -> SideTable:
    """Return the summary figures of the protocols; a row that departs from its protocol has none."""
    rows = table.protocols
    has_groups = any(row.group is not None for row in rows)
    has_variants = any(row.variant is not None for row in rows)
    return SideTable(
        title="Summary figures of protocols: mean of success once over the tasks",
        titles=[
            "protocol",
            *(["tasks of"] if has_groups else []),
            *("policy", "K"),
            *(["variant"] if has_variants else []),
            *("mean", "lowest, highest task", "runs", "departs from the protocol"),
        ],
        rows=[
            [
                f"{row.protocol} v{row.version}",
                *([row.group or UNDEFINED] if has_groups else []),
                *(row.policy, str(row.n_action_steps)),
                *([row.variant or UNDEFINED] if has_variants else []),
                *(_mean(row), _spread(row), str(row.n_runs), "; ".join(row.departures) or "no"),
            ]
            for row in rows
        ],
        is_number=[
            False,
            *([False] if has_groups else []),
            *(False, True),
            *([False] if has_variants else []),
            *(True, True, True, False),
        ],
        notes=_protocol_notes(rows),
        csv_columns=("departures",),
        csv_rows=[_csv_row(row) for row in rows],
        json_name="protocols",
        json_value=[asdict(row) for row in rows],
    )


def _mean(row: ProtocolRow) -> str:
    if row.mean is None:
        return NOT_THE_PROTOCOL
    sem = "" if row.sem is None else f" ± {row.sem:.2f}"
    return f"{row.mean:.2f}{sem} [{rate(row.ci_low)}, {rate(row.ci_high)}]"


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
    own = {one.name: getattr(row, one.name) for one in fields(ProtocolRow)}
    return {
        **own,
        "source": f"protocol {row.protocol} v{row.version}",
        "task": f"mean of {row.n_tasks} tasks" + (f" ({row.group})" if row.group else ""),
        "success_once": row.mean,
        "departures": "; ".join(row.departures),
    }
