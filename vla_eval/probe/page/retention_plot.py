"""The retention curves of a probe, for the report page and as PNG files."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from vla_eval.page.charts import Curves, Point, Series, curves_png
from vla_eval.probe.page.memory_plot import decoding_curves
from vla_eval.probe.page.png_files import write_beside
from vla_eval.probe.retention_curves import Retention
from vla_eval.probe.table import ProbeTable

CURVES: dict[str, str] = {"follows": "follows the cue", "warranted_choice": "follows the cue in both worlds"}


def write_retention(table: ProbeTable, folder: Path) -> list[Path]:
    """Write a PNG file per task and kind of curve, next to the folder of runs, and return their paths.

    Beside retention, what linear probes decode.
    """
    drawn = {
        f"{own[0].task}_{own[0].of}": curves_png(retention_lines(own, line_colors(own)))
        for own in by_kind(table.retention)
    }
    for (task, label), one in decoding_curves(table.decoded).items():
        drawn[f"{task}_{label.replace(' ', '_')}_decoded"] = curves_png(one)
    return write_beside(folder, drawn)


def by_kind(curves: Sequence[Retention]) -> list[list[Retention]]:
    """Return the curves of each task and kind, which are drawn together."""
    kinds = dict.fromkeys((curve.task, curve.of) for curve in curves)
    return [[curve for curve in curves if (curve.task, curve.of) == kind] for kind in kinds]


def line_colors(curves: Sequence[Retention]) -> dict[str, int]:
    """Return the color of each curve by the name of its line."""
    return {name: number for number, name in enumerate(dict.fromkeys(map(line_name, curves)))}


def retention_lines(curves: Sequence[Retention], colors: Mapping[str, int]) -> Curves:
    """Return curves of one task and kind on a logarithmic axis, with the chance level where it is known."""
    delays = sorted({point.delay_steps for curve in curves for point in curve.points})
    series = [
        Series(
            name=line_name(one),
            color=colors[line_name(one)],
            points=tuple(Point(_x(p.delay_steps), p.share.rate, *p.share.interval) for p in one.points),
        )
        for one in curves
    ]
    points = [point for curve in curves for point in curve.points]
    chances = {point.delay_steps: point.chance for point in points if point.chance is not None}
    if chances:
        level = tuple(Point(_x(delay), chances[delay]) for delay in sorted(chances))
        series.append(Series(name="chance", color=0, points=level, kind="chance"))
    said = {
        line_name(curve): [f"{p.share.n} of {p.share.of} after {p.delay_steps}" for p in curve.points]
        for curve in curves
    }
    return Curves(
        series=series,
        title=f"{curves[0].task}: {CURVES[curves[0].of]}",
        description="; ".join(f"{name}: {', '.join(words)}" for name, words in said.items()),
        x_title="delay, steps (logarithmic)",
        x_ticks=[_x(delay) for delay in delays],
        x_labels=[str(delay) for delay in delays],
    )


def line_name(curve: Retention) -> str:
    """Return the name of a curve's line."""
    return f"{curve.policy} · K={curve.n_action_steps}"


def _x(delay_steps: int) -> float:
    """Return the place of a delay on a logarithmic axis that has a place for 0."""
    return math.log2(1 + delay_steps)
