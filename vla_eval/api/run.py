"""`vla_eval.load_run`: what run folders hold, as tables, data frames and pages."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self  # plain data

from markupsafe import Markup

from vla_eval.errors import RunFolderError, check_names
from vla_eval.page.build import write_page
from vla_eval.page.material import gather
from vla_eval.page.rates import success_plots
from vla_eval.page.svg import FONT_SIZE_PX, PALETTE
from vla_eval.records import EpisodeRecord
from vla_eval.results.formats import FORMATS, By, Format, Preset
from vla_eval.results.report import build_table, render
from vla_eval.results.sweep import DEFAULT_DIFFERENCE, compare_runs
from vla_eval.results.sweep_format import render_sweep
from vla_eval.results.verdict import verdicts
from vla_eval.storage.run_folder import StoredRun, read_run
from vla_eval.strict.calls import public

if TYPE_CHECKING:
    import pandas as pd

FRAMES = ("table", "episodes")


class Text(str):
    """Text that Python's prompt and notebooks show as it is, not as a string in quotes."""

    written_in: Format

    def __new__(cls, text: str, format: Format) -> Self:
        """Take the text and what it is written in."""
        check_names("format", [format], FORMATS)
        made = super().__new__(cls, text)
        made.written_in = format
        return made

    def __repr__(self) -> str:
        """Return the text itself."""
        return str(self)

    def _repr_markdown_(self) -> str | None:
        return str(self) if self.written_in == "markdown" else None


class Run:
    """The results in one or more run folders; `load_run` reads them.

    Attributes:
        stored: what the folders hold, in the order in which they were named.
    """

    def __init__(self, stored: Sequence[StoredRun]) -> None:
        """Take what was read."""
        self.stored = tuple(stored)

    @property
    def path(self) -> Path:
        """The (first) run folder."""
        return self.stored[0].path

    @property
    def records(self) -> tuple[EpisodeRecord, ...]:
        """Every episode: of each the success or failure if there is one, else the last error."""
        return tuple(record for run in self.stored for record in run.records)

    @public
    def table(
        self,
        format: Format = "markdown",
        *,
        baseline: str | None = None,
        columns: Sequence[str] = (),
        wide: bool = False,
        preset: Preset | None = None,
        paper: bool = False,
        published: str | None = None,
    ) -> Text:
        """Return the success table, as `mikasa-vla report` prints it; arguments are the verb's flags.

        Raises:
            ReportError: there is no episode yet, or the format does not take an argument.
            UnknownNameError: there is no such baseline, column or board.
        """
        table = build_table(self.stored, baseline=baseline)
        return Text(
            render(
                table, format, columns=columns, wide=wide, preset=preset, paper=paper, published=published
            ),
            format,
        )

    @public
    def to_pandas(self, kind: Literal["table", "episodes"] = "table") -> "pd.DataFrame":
        """Return a data frame.

        Args:
            kind: `table`: the rows of the table, with the columns of `--format csv` (docs/statistics.md);
                `episodes`: one row per `EpisodeRecord`, with its fields as columns; of an error there are
                `error_kind`, `error_stage` and `error_message`.

        Raises:
            UnknownNameError: there is no such kind.
        """
        import pandas as pd

        check_names("kind of data frame", [kind], FRAMES, where="to_pandas")
        if kind == "table":
            return pd.DataFrame([row.to_dict() for row in build_table(self.stored).rows])
        return pd.DataFrame([_episode(run, record) for run in self.stored for record in run.records])

    @public
    def compare(
        self,
        *,
        by: By = "n_action_steps",
        reference: str | int | None = None,
        difference: float = DEFAULT_DIFFERENCE,
        format: Format = "markdown",
    ) -> Text:
        """Compare chunk sizes or policies on the same seeds, as `mikasa-vla compare` does.

        Raises:
            ReportError: there is nothing to compare, or an impossible difference.
            UnknownNameError: there is no such reference.
        """
        named = None if reference is None else str(reference)
        sweep = compare_runs(self.stored, by=by, reference=named, difference=difference)
        return Text(render_sweep(sweep, format), format)

    @public
    def page(self, folder: str | Path | None = None, *, baseline: str | None = None) -> Path:
        """Write the report page and return its file; by default in a folder beside the run's.

        Raises:
            ReportError: there is no episode yet, or the page cannot be written there.
        """
        place = Path(folder) if folder is not None else self.path.with_name(f"{self.path.name}-report")
        return write_page(self.stored, place, baseline=baseline)

    def __repr__(self) -> str:
        """Return the folders and how many episodes they hold."""
        n_errors = sum(record.error is not None for record in self.records)
        errors = f", {n_errors} errors" if n_errors else ""
        folders = ", ".join(str(run.path) for run in self.stored)
        return f"<Run {folders}: {len(self.records) - n_errors} episodes{errors}>"

    def _repr_html_(self) -> str:
        """Return table, verdict and plot, for notebooks."""
        if not self.records:
            return str(Markup("<p>{}: no episode yet</p>").format(self.path))
        material = gather(self.stored, baseline=None)
        found = verdicts(material.table)
        said = [Markup("<p><b>{}</b>: {}</p>").format(one.task, " ".join(one.sentences)) for one in found]
        charts = [chart.svg for chart in success_plots(material).charts]
        return notebook_html(render(material.table, "html-table"), [*said, in_colors(charts)])


def notebook_html(table: str, below: Sequence[Markup]) -> str:
    """Return a result as HTML for a notebook: the table, then sentences and plots."""
    return str(Markup("\n").join([Markup(table), *below]))


def in_colors(drawn: Sequence[Markup]) -> Markup:
    """Return drawings of the report page as they look there: a notebook has none of its styles."""
    colors = "; ".join(f"--{name}: {color}" for name, color in PALETTE.items())
    style = f"font-size: {FONT_SIZE_PX}px; {colors}"
    return Markup('<div style="{}">{}</div>').format(style, Markup("\n").join(drawn))


@public
def load_run(*folders: str | Path) -> Run:
    """Read run folders without touching them; a run may be writing to one.

    Raises:
        RunFolderError: one is not a run folder, or a file in it is damaged.
    """
    if not folders:
        raise RunFolderError("load_run: expected at least one run folder, found none.")
    return Run([read_run(Path(folder)) for folder in folders])


def _episode(run: StoredRun, record: EpisodeRecord) -> dict[str, Any]:
    cells = asdict(record)
    error = cells.pop("error")
    errors = {f"error_{name}": error and error[name] for name in ("kind", "stage", "message")}
    return {"run_folder": str(run.path), **cells, **errors}
