"""The sections of the report page on probes and grids, from their run folders."""

import base64
import io
from collections.abc import Sequence

from PIL import Image

from vla_eval.page.charts import curves, reference_sign, sign
from vla_eval.page.heat import heat_chart
from vla_eval.page.probe_section import FilmFrame, FilmPair, Filmstrip, ProbeSection
from vla_eval.page.rates import Plots, Sign
from vla_eval.page.tables import Matrix, page_table, shaded
from vla_eval.probe.choice_pairs import ChoicePairs
from vla_eval.probe.decoding_text import printed_decoding
from vla_eval.probe.find_worlds import Found, FoundProbe, find_probes
from vla_eval.probe.grid_text import grid_notes, grid_sentences, printed_grid
from vla_eval.probe.page.heat_maps import heat_maps
from vla_eval.probe.page.memory_plot import decoding_curves
from vla_eval.probe.page.retention_plot import CURVES, by_kind, line_colors, line_name, retention_lines
from vla_eval.probe.probe_text import printed_probe
from vla_eval.probe.sentences import half_life_text, notes, sentences
from vla_eval.probe.table import ProbeTable
from vla_eval.probe.worlds import World
from vla_eval.records import EpisodeRecord
from vla_eval.results.printed_table import UNDEFINED, PrintedTable
from vla_eval.storage.capture_files import video_file
from vla_eval.storage.run_folder import StoredRun
from vla_eval.tasks.interface import CONTROL_HZ
from vla_eval.tasks.objects.item_names import item_names


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
        plots=retention_plots(table) if table.retention else None,
        curves_table=_half_lives(table) if table.retention else None,
        memory_plots=_memory_plots(table) if table.decoded else None,
        memory_table=printed_decoding(table.decoded) if table.decoded else None,
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


def retention_plots(table: ProbeTable) -> Plots:
    """Draw the retention curves, one chart per task and kind of curve; delays on a logarithmic axis."""
    colors = line_colors(table.retention)
    legend = (
        *(Sign(name, sign(number, is_line=False)) for name, number in colors.items()),
        Sign("chance", reference_sign("chance")),
    )
    charts = (curves(retention_lines(own, colors)) for own in by_kind(table.retention))
    return Plots(legend=legend, charts=tuple(charts))


def _memory_plots(table: ProbeTable) -> Plots:
    """Draw what linear probes decode, a chart per task and label."""
    drawn = decoding_curves(table.decoded)
    names = dict.fromkeys(one.name for curve in drawn.values() for one in curve.series if one.kind == "solid")
    legend = (
        *(Sign(name, sign(number, is_line=False)) for number, name in enumerate(names)),
        Sign("chance", reference_sign("chance")),
    )
    return Plots(legend=legend, charts=tuple(map(curves, drawn.values())))


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


MOST_PAIRS = 3
N_FRAMES = 6
WIDTH_PX = 340  # twice of what the page shows, for screens with fine pixels
JPEG_QUALITY = 75


def film_pairs(worlds: Sequence[Found[World]], pairs: Sequence[ChoicePairs]) -> tuple[FilmPair, ...]:
    """Return the first captured pair of each policy with a swapped cue, of `MOST_PAIRS` policies."""
    runs = [one.run for one in worlds]
    films: dict[tuple[str, str, int], FilmPair] = {}
    for one in pairs:
        key = (one.world.task, one.policy, one.n_action_steps)
        if key in films or len(films) == MOST_PAIRS:
            continue
        for pair in one.pairs:
            found = [_captured(runs, record) for record in pair]
            if None not in found:
                strips = [_strip(run, record) for run, record in zip(found, pair, strict=True) if run]
                films[key] = FilmPair(
                    title=f"{one.world.task}, {one.policy} · K={one.n_action_steps}, seed {pair.drawn.seed}: "
                    f"as drawn, and {one.world.label}",
                    strips=tuple(strips),
                )
                break
    return tuple(films.values())


def _captured(runs: Sequence[StoredRun], record: EpisodeRecord) -> StoredRun | None:
    """Return the run that a record is of, if its video is there."""
    own = (run for run in runs if any(record is one for one in run.records))
    return next((run for run in own if video_file(run.path, record).is_file()), None)


def _strip(run: StoredRun, record: EpisodeRecord) -> Filmstrip:
    # Here and not above: only a page with videos waits for the decoder.
    from vla_eval.viz.filmstrip import read_strip

    assert record.n_steps is not None  # a pair has results
    frames = read_strip(
        video_file(run.path, record), n_frames=N_FRAMES, n_steps=record.n_steps, control_hz=CONTROL_HZ
    )
    names = item_names(record.task, record.n_candidates or 0, given=record.candidate_names)
    target = "several" if record.target is None else names[record.target]
    chosen = "none" if record.first_choice is None else names[record.first_choice]
    return Filmstrip(
        caption=f"cue {target}, chosen {chosen}: {record.outcome}",
        frames=tuple(FilmFrame(frame.step, _jpeg_uri(Image.fromarray(frame.image))) for frame in frames),
    )


def _jpeg_uri(image: Image.Image) -> str:
    file = io.BytesIO()
    height = round(image.height * WIDTH_PX / image.width)
    image.resize((WIDTH_PX, height), Image.Resampling.LANCZOS).save(file, format="JPEG", quality=JPEG_QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"
