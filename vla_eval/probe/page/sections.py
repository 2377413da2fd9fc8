"""The sections of the report page on probes and grids, from their run folders."""

from collections.abc import Sequence

from vla_eval.page.charts import curves, reference_sign, sign
from vla_eval.page.heat import heat_chart
from vla_eval.page.probe_section import ProbeSection
from vla_eval.page.rates import Plots, Sign
from vla_eval.page.tables import Matrix, page_table, shaded
from vla_eval.probe.choice_pairs import ChoicePairs
from vla_eval.probe.find_worlds import FoundProbe, find_probes
from vla_eval.probe.grid_sentences import grid_notes, grid_sentences
from vla_eval.probe.grid_text import printed_grid
from vla_eval.probe.page.films import film_pairs
from vla_eval.probe.page.heat_maps import heat_maps
from vla_eval.probe.page.retention_plot import CURVES, by_kind, line_colors, line_name, retention_lines
from vla_eval.probe.probe_text import printed_probe
from vla_eval.probe.sentences import half_life_text, notes, sentences
from vla_eval.probe.table import ProbeTable
from vla_eval.results.printed_table import UNDEFINED, PrintedTable
from vla_eval.storage.run_folder import StoredRun


def probe_sections(runs: Sequence[StoredRun]) -> list[ProbeSection]:
    """Return a section for each probe and each grid among the run folders; videos are read from these."""
    sections = []
    for probe in find_probes(runs):
        if probe.worlds:
            sections.append(_probe_section(probe))
        if probe.grid:
            sections.append(_grid_section(probe))
    return sections


def _probe_section(probe: FoundProbe) -> ProbeSection:
    table, pairs = probe.table(), probe.pairs()
    return ProbeSection(
        title=str(probe.folder),
        table=printed_probe(table),
        sentences=tuple(sentences(table)),
        notes=(*notes(table), *probe.doubles),
        plots=_retention_plots(table) if table.retention else None,
        curves_table=_half_lives(table) if table.retention else None,
        matrices=tuple(map(_matrix, pairs)),
        films=film_pairs(probe.worlds, pairs),
    )


def _grid_section(probe: FoundProbe) -> ProbeSection:
    table = probe.grid_table()
    return ProbeSection(
        title=f"{probe.folder}: grid",
        table=printed_grid(table),
        sentences=tuple(grid_sentences(table)),
        notes=tuple(grid_notes(table)),
        heat=tuple(
            (f"{task}: success once by K and {axis}", tuple(map(heat_chart, maps)))
            for (task, axis), maps in heat_maps(table).items()
        ),
    )


def _retention_plots(table: ProbeTable) -> Plots:
    """Draw the retention curves, one chart per task and kind of curve; delays on a logarithmic axis."""
    colors = line_colors(table.retention)
    legend = (
        *(Sign(name, sign(number, is_line=False)) for name, number in colors.items()),
        Sign("chance", reference_sign("chance")),
    )
    charts = (curves(retention_lines(own, colors)) for own in by_kind(table.retention))
    return Plots(legend=legend, charts=tuple(charts))


def _half_lives(table: ProbeTable) -> PrintedTable:
    rows = [
        [
            f"{curve.task} · {line_name(curve)}",
            CURVES[curve.of],
            UNDEFINED if curve.half_life is None else half_life_text(curve.half_life),
            UNDEFINED if curve.points[0].chance is None else f"{curve.points[0].chance:.2f}",
        ]
        for curve in table.retention
    ]
    return page_table(rows, text=("policy", "curve", "half-life"), numbers=("chance",))


def _matrix(pairs: ChoicePairs) -> Matrix:
    indices = range(len(pairs.names))
    return Matrix(
        title=f"{pairs.world.task}, {pairs.policy} · K={pairs.n_action_steps}: as drawn (rows), "
        f"{pairs.world.label} (columns)",
        names=pairs.names,
        columns=pairs.names,
        rows=shaded(
            [[pairs.counts.get((row, column), 0) for column in indices] for row in indices],
            lambda row, column: (row, column) in pairs.following,
        ),
    )
