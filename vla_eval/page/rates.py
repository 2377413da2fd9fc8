"""The sections of the report page that show success: the table, by task, by K, paired, and over time."""

import json
from collections.abc import Sequence

from vla_eval.errors import ReportError
from vla_eval.page.charts import Bar, LineKind, Point, Series, curves, forest, legend
from vla_eval.page.markup import (
    UNKNOWN,
    Markup,
    details,
    element,
    joined,
    paragraph,
    section,
    table,
    with_code,
)
from vla_eval.page.material import Material, key_of
from vla_eval.results.sweep import compare_runs
from vla_eval.results.sweep_format import sweep_cells, sweep_notes
from vla_eval.results.table import Row
from vla_eval.results.table_formats import table_cells

N_STEP_TICKS = 5


def table_section(material: Material) -> Markup:
    """Show the table that `mikasa-vla report` prints, each row with its JSON."""
    columns, rows = table_cells(material.table)
    shown = table(
        [column.title for column in columns],
        rows,
        numeric=[column.is_number for column in columns],
        caption="Success by task, policy and K (actions executed per inference)",
        row_data=[json.dumps(row.to_dict(), ensure_ascii=False) for row in material.table.rows],
    )
    return section("table", "Results", shown, _notes(material.table.notes))


def success_section(material: Material) -> Markup:
    """Show success once by task, with intervals, chance and ceiling."""
    plots = []
    for task in material.tasks:
        bars = [
            Bar(
                label=material.name_of(row),
                color=material.colors[row.policy],
                value=row.success_once,
                low=row.ci_low,
                high=row.ci_high,
                chance=row.chance,
                ceiling=row.ceiling,
            )
            for row in material.rows_of(task)
        ]
        described = "; ".join(f"{bar.label}: {_rate(bar.value)} ({_interval(bar)})" for bar in bars)
        plots.append(forest(bars, title=f"{task}: success once", description=described))
    return section(
        "success",
        "Success by task",
        paragraph(
            "Success at any step of the episode, with its 95 % interval. The broken tick is chance, what a "
            "perfect arm without memory gets; the dotted one is the ceiling, the expert that is told the "
            "answer. A policy whose interval holds the chance tick has not been shown to remember.",
            muted=True,
        ),
        legend([]),
        element("div", *plots, class_="plots"),
    )


def chunk_section(material: Material) -> Markup:
    """Show success against n_action_steps, with lines of chance and ceiling."""
    plots: list[Markup] = []
    names: dict[str, int] = {}
    for task in material.tasks:
        rows = [row for row in material.rows_of(task) if row.success_once is not None]
        sizes = sorted({row.n_action_steps for row in rows})
        for variant in dict.fromkeys(row.variant for row in rows):
            own = [row for row in rows if row.variant == variant]
            if len({row.n_action_steps for row in own}) < 2:
                continue
            names |= {row.policy: material.colors[row.policy] for row in own}
            title = f"{task}: success against K" + (f", {variant}" if variant else "")
            plots.append(
                curves(
                    _by_chunk(material, own),
                    title=title,
                    description=_values(material, own),
                    x_title="K, actions executed per inference",
                    x_ticks=sizes,
                )
            )
    if not plots:
        said = paragraph("Only one n_action_steps (K) was evaluated per task: there is nothing to draw.")
        return section("chunks", "Success against n_action_steps", said)
    return section(
        "chunks",
        "Success against n_action_steps",
        legend(list(names.items())),
        element("div", *plots, class_="plots"),
        _sweep(material),
    )


def paired_section(material: Material) -> Markup:
    """Show each policy against the baseline, on the same episodes."""
    title = "Paired comparison"
    if not material.pairs:
        why = (
            f"No policy shares episodes with the baseline '{material.table.baseline}'."
            if material.table.baseline
            else "There is no baseline among these policies: run `random` too, or name one with --baseline."
        )
        return section("paired", title, paragraph(why))
    rows = []
    for row in material.table.rows:
        pairs = material.pairs.get(key_of(row))
        if pairs is None or row.paired_difference is None:
            continue
        rows.append(
            [
                material.name_of(row, with_task=True),
                f"{row.baseline} K={row.baseline_n_action_steps}",
                *map(str, (pairs.n_pairs, pairs.both, pairs.only_first, pairs.only_second, pairs.neither)),
                f"{row.paired_difference:+.2f}",
                _p(row.paired_p_raw),
                _p(row.paired_p),
            ]
        )
    titles = ("policy", "against", "pairs", "both", "only it", "only the baseline", "neither")
    return section(
        "paired",
        title,
        paragraph(
            "The same episodes (task, run, seed) for both. p: exact McNemar test, two-sided; Holm's "
            f"correction over all {material.table.n_comparisons} comparisons of this table.",
            muted=True,
        ),
        table((*titles, "difference", "p", "p (Holm)"), rows, numeric=[False, False, *[True] * 8]),
    )


def steps_section(material: Material) -> Markup:
    """Show how soon success comes: the share of episodes that have succeeded by each step."""
    plots: list[Markup] = []
    names: dict[str, int] = {}
    for task, size, variant in _settings(material):
        rows = [
            row
            for row in material.rows_of(task)
            if (row.n_action_steps, row.variant) == (size, variant) and row.n_episodes
        ]
        series = [_cumulative(material, row) for row in rows]
        horizon = max((point.x for one in series for point in one.points), default=0)
        if not horizon:
            continue
        names |= {row.policy: material.colors[row.policy] for row in rows}
        means = "; ".join(f"{material.name_of(row)}: {_steps(row)}" for row in rows)
        plots.append(
            curves(
                series,
                title=f"{task}, K={size}" + (f", {variant}" if variant else ""),
                description=f"Mean steps until success: {means}",
                x_title="control step",
                x_ticks=[round(horizon * i / (N_STEP_TICKS - 1)) for i in range(N_STEP_TICKS)],
            )
        )
    if not plots:
        return section("steps", "Steps to success", paragraph("No episode has a result yet."))
    return section(
        "steps",
        "Steps to success",
        paragraph(
            "Share of episodes that have succeeded by each control step; failures count in the denominator, "
            "errors do not.",
            muted=True,
        ),
        legend(list(names.items()), lines=True, references=False),
        element("div", *plots, class_="plots"),
    )


def _settings(material: Material) -> list[tuple[str, int, str | None]]:
    """Return each task, K and variant once: by task, then by K."""
    found = {(row.task, row.n_action_steps, row.variant) for row in material.table.rows}
    return sorted(found, key=lambda one: (material.tasks.index(one[0]), one[1], one[2] or ""))


def _by_chunk(material: Material, rows: Sequence[Row]) -> list[Series]:
    series = [
        Series(
            name=policy,
            color=material.colors[policy],
            points=tuple(
                Point(r.n_action_steps, r.success_once or 0.0, r.ci_low, r.ci_high)
                for r in rows
                if r.policy == policy and r.success_once is not None
            ),
        )
        for policy in dict.fromkeys(row.policy for row in rows)
    ]
    kinds: tuple[LineKind, ...] = ("chance", "ceiling")
    for kind in kinds:
        known = {r.n_action_steps: getattr(r, kind) for r in rows if getattr(r, kind) is not None}
        if known:
            points = tuple(Point(size, rate) for size, rate in sorted(known.items()))
            series.append(Series(name=kind, color=0, points=points, kind=kind))
    return series


def _cumulative(material: Material, row: Row) -> Series:
    results = material.group_of(row).results
    steps = sorted(record.success_step for record in results if record.success_step is not None)
    end = max((record.n_steps or 0 for record in results), default=0)
    points = [Point(0, 0.0), *(Point(step, (i + 1) / len(results)) for i, step in enumerate(steps))]
    points.append(Point(end, points[-1].y))
    return Series(name=row.policy, color=material.colors[row.policy], points=tuple(points), is_step=True)


def _sweep(material: Material) -> Markup:
    try:
        sweep = compare_runs(material.runs)
    except ReportError as exc:
        return paragraph(f"No paired comparison of chunk lengths: {exc}", muted=True)
    titles, rows = sweep_cells(sweep)
    first_numbers = titles.index("episodes")
    numeric = [i >= first_numbers or titles[i] == "K" for i in range(len(titles))]
    return details(
        "Chunk lengths compared on the same episodes",
        table(titles, rows, numeric=numeric),
        _notes(sweep_notes(sweep)),
    )


def _notes(notes: Sequence[str]) -> Markup:
    if not notes:
        return joined(())
    return element("ul", *(element("li", with_code(note)) for note in notes), class_="notes")


def _values(material: Material, rows: Sequence[Row]) -> str:
    return "; ".join(f"{material.name_of(row)}: {_rate(row.success_once)}" for row in rows)


def _interval(bar: Bar) -> str:
    return (
        f"{bar.low:.2f} to {bar.high:.2f}" if bar.low is not None and bar.high is not None else "no interval"
    )


def _rate(value: float | None) -> str:
    return UNKNOWN if value is None else f"{value:.2f}"


def _steps(row: Row) -> str:
    return "no success" if row.mean_success_step is None else f"{row.mean_success_step:.1f}"


def _p(value: float | None) -> str:
    return UNKNOWN if value is None else f"{value:.3g}"
