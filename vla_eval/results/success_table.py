"""The success table as data: what a statistic is, the rows, and their notes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, cast

from vla_eval.results.comparison import Evidence
from vla_eval.results.grouping import RowEpisodes, RowKey, Run
from vla_eval.results.passport.passport import Passport
from vla_eval.results.printed_table import Column

Cell = str | int | float | None
SummaryInterval = Literal["wilson_over_tasks", "t_over_runs"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Statistic[V]:
    """One statistic of a row: its estimate, and its columns and words in every format."""

    # its value, from the evidence of a row; None where it is undefined
    estimate: Callable[[Evidence], V]
    # its columns in CSV and JSON, a public format: name -> value
    cells: Callable[[V], Mapping[str, Cell]]
    columns: tuple["Column[Row]", ...] = ()  # its columns in tables for reading
    # the column of a baseline, by its number from 0 and its name, where each has one
    column_of: "Callable[[int, str], Column[Row]] | None" = None
    # the footnotes on its values in all rows of a table
    notes: "Callable[[Sequence[Row]], Iterable[str]]" = lambda _: ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One policy on one task, at one `n_action_steps` and one variant of the settings; or one run of it.

    `docs/statistics.md` says what each statistic means and how it is computed.
    """

    episodes: RowEpisodes
    # the value of each statistic, in the order of the columns of CSV and JSON
    estimates: Mapping[Statistic[Any], Any]
    # which run, for one of several; it is compared with nothing, so that no test counts twice
    run: Run | None = None

    def __getitem__[V](self, statistic: Statistic[V]) -> V:
        return cast(V, self.estimates[statistic])

    @property
    def key(self) -> RowKey:
        """Task, policy, n_action_steps and variant."""
        return self.episodes.key

    @property
    def task(self) -> str:
        """Its task."""
        return self.key.task

    @property
    def policy(self) -> str:
        """Its policy."""
        return self.key.policy

    @property
    def n_action_steps(self) -> int:
        """How many actions are executed per inference."""
        return self.key.n_action_steps

    @property
    def variant(self) -> str | None:
        """The settings that differ from the others in the table; None if there is only one."""
        return self.key.variant

    def to_dict(self) -> dict[str, Cell]:
        """Return the row by the names of the columns of CSV and JSON."""
        cells: dict[str, Cell] = self.key._asdict()
        for statistic, value in self.estimates.items():
            cells |= statistic.cells(value)
        # `copy`: above 0 where further run folders hold the same run with other trajectories or weights.
        return cells if self.run is None else {**cells, "run": self.run.index, "copy": self.run.copy}


@dataclass(frozen=True, slots=True, kw_only=True)
class ProtocolRow:
    """The summary figure of one policy at one K."""

    protocol: str
    version: int
    group: str | None  # the part of its tasks that the figure is over; None: all
    policy: str
    n_action_steps: int
    variant: str | None
    # `n_tasks`, `n_runs`: over how many tasks and runs the figure is
    n_tasks: int
    n_runs: int
    # mean over the tasks of success once; over several runs the mean of the run means. None where
    # something departs from the protocol.
    mean: float | None = None
    ci_low: float | None = None
    ci_high: float | None = None
    interval: SummaryInterval | None = None
    sem: float | None = None  # standard error over the runs
    lowest: float | None = None
    highest: float | None = None
    departures: tuple[str, ...] = ()  # what is not as the protocol says


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows and their notes."""

    rows: tuple[Row, ...]  # in the order of the configuration
    run_rows: tuple[Row, ...] = ()  # the runs of each row that has several
    notes: tuple[str, ...]
    baselines: tuple[str, ...]
    n_comparisons: int  # how many p values were corrected together
    runs: Mapping[str, str]  # run folder -> name of its configuration
    # the summary figures of published protocols, as far as the runs name any
    protocols: tuple[ProtocolRow, ...] = ()
    passports: Mapping[RowKey, Passport] = field(default_factory=dict)  # how each row was made

    @property
    def variants(self) -> dict[str, str]:
        """The settings in which run folders differ, each with its letter."""
        told = dict.fromkeys(row.variant for row in self.rows if row.variant)
        return {variant: chr(ord("a") + i) for i, variant in enumerate(told)}

    def with_runs(self) -> tuple[Row, ...]:
        """Return the rows, each followed by its runs."""
        return tuple(
            one for row in self.rows for one in (row, *(run for run in self.run_rows if run.key == row.key))
        )
