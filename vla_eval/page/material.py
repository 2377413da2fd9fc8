"""Gather, once, the data of the report page's sections. Computes nothing that is not in results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vla_eval.records import EpisodeKey, EpisodeTiming
from vla_eval.results.report import build_table
from vla_eval.results.success_table import Row, Table
from vla_eval.storage.run_folder import StoredRun
from vla_eval.storage.timings import read_timings


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """The data of a page."""

    runs: tuple[StoredRun, ...]
    table: Table  # as `mikasa-vla report` prints it
    timings: Mapping[str, Mapping[EpisodeKey, EpisodeTiming]]  # run folder -> episode -> seconds
    colors: Mapping[str, int]  # policy -> number of its colour and marker, the same in every plot

    @property
    def tasks(self) -> list[str]:
        """The tasks in the order of the table."""
        return list(dict.fromkeys(row.task for row in self.table.rows))

    def rows_of(self, task: str) -> list[Row]:
        """Return the rows of a task."""
        return [row for row in self.table.rows if row.task == task]

    def name_of(self, row: Row, *, with_task: bool = False) -> str:
        """Return the name of a row: its task, if asked for and if there are several; policy, K, variant."""
        parts = [row.task] if with_task and len(self.tasks) > 1 else []
        name = " · ".join([*parts, row.policy, f"K={row.n_action_steps}"])
        return f"{name} ({self.table.variants[row.variant]})" if row.variant else name


def gather(runs: Sequence[StoredRun], *, baseline: str | None, protocols: Sequence[str] = ()) -> Material:
    """Read and compute everything that the page shows; arguments as for `build_table`, which may refuse."""
    runs = tuple({run.path.resolve(): run for run in runs}.values())
    table = build_table(runs, baseline=baseline, protocols=protocols)
    policies = dict.fromkeys(row.policy for row in table.rows)
    return Material(
        runs=runs,
        table=table,
        timings={str(run.path): read_timings(run.path) for run in runs},
        colors={policy: number for number, policy in enumerate(policies)},
    )
