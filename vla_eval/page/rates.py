"""The page's sections on success: the table, by task, by K, paired, and over time."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from markupsafe import Markup

from vla_eval.errors import ReportError
from vla_eval.page.charts import (
    Bar,
    Chart,
    Curves,
    LineKind,
    Point,
    Series,
    curves,
    forest,
    labels_width_px,
    reference_sign,
    sign,
)
from vla_eval.page.material import Material
from vla_eval.page.tables import page_table
from vla_eval.results.own_statistics import EPISODES, STEPS, SUCCESS, rate
from vla_eval.results.printed_table import UNDEFINED, PrintedTable
from vla_eval.results.relative_statistics import CEILING, CHANCE, PAIRED
from vla_eval.results.success_table import Row
from vla_eval.results.sweep import compare_runs
from vla_eval.results.sweep_format import sweep_table
from vla_eval.results.table_columns import lay_out

MAX_STEP_TICKS = 7


class Sign(NamedTuple):
    """One entry of a legend."""

    name: str
    svg: Markup


@dataclass(frozen=True, slots=True, kw_only=True)
class Plots:
    """Charts that share a legend; no chart if there is nothing to draw."""

    legend: tuple[Sign, ...]
    charts: tuple[Chart, ...]


class Results(NamedTuple):
    """The table that `mikasa-vla report` prints, the JSON of each row, and the table of all columns."""

    table: PrintedTable
    row_data: tuple[str, ...]
    wide: PrintedTable


def results(material: Material) -> Results:
    """Return the table as the terminal has it, and with all columns."""
    rows = tuple(json.dumps(row.to_dict(), ensure_ascii=False) for row in material.table.rows)
    return Results(lay_out(material.table), rows, lay_out(material.table, wide=True))


def success_plots(material: Material) -> Plots:
    """Draw success once by task, with intervals, chance and ceiling."""
    charts = []
    label_px = labels_width_px(material.name_of(row) for row in material.table.rows)
    for task in material.tasks:
        bars = [
            Bar(
                label=material.name_of(row),
                color=material.colors[row.policy],
                value=row[SUCCESS].success_once,
                low=row[SUCCESS].ci_low,
                high=row[SUCCESS].ci_high,
                chance=_chance(row),
                ceiling=row[CEILING],
            )
            for row in material.rows_of(task)
        ]
        described = "; ".join(
            f"{bar.label}: {rate(bar.value)} "
            + ("(no interval)" if bar.low is None else f"({bar.low:.2f} to {bar.high:.2f})")
            for bar in bars
        )
        title = f"{task}: success once"
        charts.append(forest(bars, title=title, description=described, label_px=label_px))
    return Plots(legend=_reference_signs(), charts=tuple(charts))


def chunk_plots(material: Material) -> Plots:
    """Draw success against n_action_steps, with lines of chance and ceiling."""
    charts: list[Curves] = []
    colors: dict[str, int] = {}
    for task in material.tasks:
        rows = [row for row in material.rows_of(task) if row[SUCCESS].success_once is not None]
        sizes = sorted({row.n_action_steps for row in rows})
        for variant in dict.fromkeys(row.variant for row in rows):
            own = [row for row in rows if row.variant == variant]
            if len({row.n_action_steps for row in own}) < 2:
                continue
            colors |= {row.policy: material.colors[row.policy] for row in own}
            described = "; ".join(
                f"{material.name_of(row)}: {rate(row[SUCCESS].success_once)}" for row in own
            )
            charts.append(
                Curves(
                    series=_by_chunk(material, own),
                    title=f"{task}: success against K" + (f", {variant}" if variant else ""),
                    description=described,
                    x_title="K, actions executed per inference",
                    x_ticks=sizes,
                )
            )
    return Plots(
        legend=(*_signs(colors, is_line=False), *_reference_signs()), charts=tuple(map(curves, charts))
    )


def chunk_sweep(material: Material) -> PrintedTable | str:
    """Return the comparison of chunk lengths on the same episodes; if there is none, why."""
    try:
        table = sweep_table(compare_runs(material.runs))
    except ReportError as exc:
        return str(exc)
    # On the page, all columns from the episodes on are aligned to the right, intervals included.
    n_texts = table.titles.index("episodes")
    columns = (replace(one, is_number=one.is_number or i >= n_texts) for i, one in enumerate(table.columns))
    return replace(table, columns=tuple(columns))


def paired_table(material: Material) -> PrintedTable:
    """Return the counts of each policy against each baseline."""
    rows = []
    for row in material.table.rows:
        for found in row[PAIRED]:
            if found is None:
                continue
            test = found.test
            rows.append(
                [
                    material.name_of(row, with_task=True),
                    f"{found.baseline.policy} K={found.baseline.n_action_steps}",
                    *map(str, (found.pairs.n_pairs, *found.pairs)),
                    f"{test.difference:+.2f} [{test.interval.low:+.2f}, {test.interval.high:+.2f}]",
                    _p(test.p_value),
                    _p(found.corrected_p),
                ]
            )
    counted = ("pairs", "both", "only it", "only the baseline", "neither")
    return page_table(rows, text=("policy", "against"), numbers=(*counted, "difference", "p", "p (Holm)"))


def steps_plots(material: Material) -> Plots:
    """Draw the time to success: the share of episodes that have succeeded by each step."""
    charts: list[Curves] = []
    colors: dict[str, int] = {}
    settings = {(row.task, row.n_action_steps, row.variant) for row in material.table.rows}
    # By task, then by K.
    order = sorted(settings, key=lambda one: (material.tasks.index(one[0]), one[1], one[2] or ""))
    for task, size, variant in order:
        rows = [
            row
            for row in material.rows_of(task)
            if (row.n_action_steps, row.variant) == (size, variant) and row[EPISODES].n_episodes
        ]
        # With `stop_at_success` only failures last until the horizon.
        horizon = max((r.n_steps or 0 for row in rows for r in row.episodes.results), default=0)
        if not horizon:
            continue
        series = [_cumulative(material, row, horizon) for row in rows]
        colors |= {row.policy: material.colors[row.policy] for row in rows}
        means = "; ".join(f"{material.name_of(row)}: {_steps(row)}" for row in rows)
        charts.append(
            Curves(
                series=series,
                title=f"{task}, K={size}" + (f", {variant}" if variant else ""),
                description=f"Mean steps until success: {means}",
                x_title="control step",
                x_ticks=_round_ticks(horizon),
            )
        )
    return Plots(legend=_signs(colors, is_line=True), charts=tuple(map(curves, charts)))


def _signs(colors: dict[str, int], *, is_line: bool) -> tuple[Sign, ...]:
    return tuple(Sign(name, sign(color, is_line=is_line)) for name, color in colors.items())


def _reference_signs() -> tuple[Sign, ...]:
    return tuple(Sign(name, reference_sign(name)) for name in ("chance", "ceiling"))


def _by_chunk(material: Material, rows: Sequence[Row]) -> list[Series]:
    series = [
        Series(
            name=policy,
            color=material.colors[policy],
            points=tuple(
                Point(row.n_action_steps, success, row[SUCCESS].ci_low, row[SUCCESS].ci_high)
                for row in rows
                if row.policy == policy and (success := row[SUCCESS].success_once) is not None
            ),
        )
        for policy in dict.fromkeys(row.policy for row in rows)
    ]
    kinds: dict[LineKind, Callable[[Row], float | None]] = {
        "chance": _chance,
        "ceiling": lambda row: row[CEILING],
    }
    for kind, rate_of in kinds.items():
        known = {r.n_action_steps: found for r in rows if (found := rate_of(r)) is not None}
        if known:
            points = tuple(Point(size, found) for size, found in sorted(known.items()))
            series.append(Series(name=kind, color=0, points=points, kind=kind))
    return series


def _round_ticks(end: int) -> list[int]:
    """Return 0 and multiples of 1, 2 or 5 times a power of ten, the last at or beyond the end."""
    step = next(
        size * 10**power
        for power in range(9)
        for size in (1, 2, 5)
        if -(-end // (size * 10**power)) < MAX_STEP_TICKS
    )
    return list(range(0, end + step, step))


def _cumulative(material: Material, row: Row, horizon: int) -> Series:
    results = row.episodes.results
    steps = sorted(record.success_step for record in results if record.success_step is not None)
    points = [Point(0, 0.0), *(Point(step, (i + 1) / len(results)) for i, step in enumerate(steps))]
    points.append(Point(horizon, points[-1].y))
    return Series(name=row.policy, color=material.colors[row.policy], points=tuple(points), is_step=True)


def _steps(row: Row) -> str:
    steps = row[STEPS]
    return "no success" if steps is None else f"{steps:.1f}"


def _chance(row: Row) -> float | None:
    chance = row[CHANCE]
    return None if chance is None else chance.rate


def _p(value: float | None) -> str:
    return UNDEFINED if value is None else f"{value:.3g}"
