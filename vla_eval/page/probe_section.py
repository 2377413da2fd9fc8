"""What the page shows of a probe: tables, charts and text. Knows neither worlds nor statistics."""

from dataclasses import dataclass
from typing import NamedTuple

from vla_eval.page.charts import Chart
from vla_eval.page.rates import Plots
from vla_eval.page.tables import Matrix
from vla_eval.results.printed_table import PrintedTable


class FilmFrame(NamedTuple):
    """An image as `data:` URI, and the control step that it is of."""

    step: int
    src: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Filmstrip:
    """Frames of one episode, and its caption."""

    caption: str
    frames: tuple[FilmFrame, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmPair:
    """The two episodes of a pair."""

    title: str
    strips: tuple[Filmstrip, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeSection:
    """A probe, or a grid."""

    title: str
    table: PrintedTable
    sentences: tuple[str, ...]
    notes: tuple[str, ...]
    plots: Plots | None = None
    curves_table: PrintedTable | None = None
    memory_plots: Plots | None = None  # what is in the memory, over the control steps
    memory_table: PrintedTable | None = None
    heat: tuple[tuple[str, tuple[Chart, ...]], ...] = ()
    # pairs by first choice in the world as drawn (rows) and in the other one (columns); a cell is right
    # if some of its pairs follow both cues
    matrices: tuple[Matrix, ...] = ()
    films: tuple[FilmPair, ...] = ()
