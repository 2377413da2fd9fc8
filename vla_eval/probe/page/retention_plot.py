"""The retention curves of a probe, for the report page and as PNG files."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_eval.page.charts import Point, Series, curves_png
from vla_eval.probe.page.png_files import write_beside
from vla_eval.probe.retention_curves import Retention
from vla_eval.probe.table import ProbeTable

X_TITLE = "delay, steps (logarithmic)"
CURVES: dict[str, str] = {
    "follows": "follows the cue",
    "warranted_choice": "follows the cue in both worlds",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class RetentionLines:
    """Curves of the same kind and task, on a logarithmic axis that has a place for a delay of 0."""

    series: tuple[Series, ...]
    x_ticks: tuple[float, ...]
    x_labels: tuple[str, ...]


def write_retention(table: ProbeTable, folder: Path) -> list[Path]:
    """Write a PNG file per task and kind of curve, such as `OUT_TASK_follows.png`, and return their paths.

    They are beside the folder and not in it, so that all it holds are run folders.

    Raises:
        ReportError: a file cannot be written.
    """
    written = []
    for task, of in dict.fromkeys((curve.task, curve.of) for curve in table.retention):
        own = [curve for curve in table.retention if (curve.task, curve.of) == (task, of)]
        written.append(write_beside(folder, f"{task}_{of}", retention_png(own)))
    return written


def retention_png(curves: Sequence[Retention]) -> bytes:
    """Return curves of one task and kind; the same curves give the same bytes."""
    lines = retention_lines(curves, {name: n for n, name in enumerate(dict.fromkeys(map(line_name, curves)))})
    return curves_png(
        lines.series,
        title=f"{curves[0].task}: {CURVES[curves[0].of]}",
        x_title=X_TITLE,
        x_ticks=lines.x_ticks,
        x_labels=lines.x_labels,
    )


def retention_lines(curves: Sequence[Retention], colors: Mapping[str, int]) -> RetentionLines:
    """Return what is drawn of curves of one task and kind, with the chance level where it is known."""
    delays = sorted({point.delay_steps for curve in curves for point in curve.points})
    series = [
        Series(
            name=line_name(curve),
            color=colors[line_name(curve)],
            points=tuple(
                Point(_x(point.delay_steps), point.share.rate, *point.share.interval)
                for point in curve.points
            ),
        )
        for curve in curves
    ]
    chances = {
        point.delay_steps: point.chance
        for curve in curves
        for point in curve.points
        if point.chance is not None
    }
    if chances:
        points = tuple(Point(_x(delay), chances[delay]) for delay in sorted(chances))
        series.append(Series(name="chance", color=0, points=points, kind="chance"))
    return RetentionLines(
        series=tuple(series),
        x_ticks=tuple(_x(delay) for delay in delays),
        x_labels=tuple(str(delay) for delay in delays),
    )


def line_name(curve: Retention) -> str:
    """Return the name of a curve's line."""
    return f"{curve.policy} · K={curve.n_action_steps}"


def _x(delay_steps: int) -> float:
    """Return the place of a delay on a logarithmic axis that has a place for 0."""
    return math.log2(1 + delay_steps)
