"""The statistics that place a row: against baselines, chance and the ceiling; and the footnotes on them."""

from collections.abc import Iterator, Sequence

from vla_eval.errors import some_of
from vla_eval.results.comparison import CHANCE_POLICY, TOUR_POLICY, Chance, Comparison
from vla_eval.results.estimates import chance_corrected
from vla_eval.results.own_statistics import EPISODES, SUCCESS, count, rate
from vla_eval.results.printed_table import UNDEFINED, Column
from vla_eval.results.success_table import Cell, Row, Statistic
from vla_eval.tasks.catalog import find_task

SMALLEST_SHOWN_P = 0.001
VAGUE = 0.4  # width of an interval of chance; 20 episodes at a third have 0.39
BY_ARITHMETIC = ("1/N", "catalogue")
"""Sources of a chance that was not measured."""
NO_BASELINES = ("baseline", "second baseline")
"""Words for the baselines that a table has not: so many have columns in any table, empty ones included."""
FIRST_NAMES = (
    *("baseline", "baseline_n_action_steps", "paired_difference", "paired_low", "paired_high"),
    *("n_pairs", "paired_p", "paired_p_raw"),
)
NEXT_NAMES = ("baseline", "n_action_steps", "difference", "low", "high", "n_pairs", "p", "p_raw")


def _ordinal(number: int) -> str:
    return {1: "second", 2: "third"}.get(number, f"{number + 1}th")


def _paired_cells(comparisons: Sequence[Comparison | None]) -> dict[str, Cell]:
    cells: dict[str, Cell] = {}
    for number in range(max(len(NO_BASELINES), len(comparisons))):
        names = FIRST_NAMES if not number else [f"{_ordinal(number)}_{name}" for name in NEXT_NAMES]
        one = comparisons[number] if number < len(comparisons) else None
        cells |= dict.fromkeys(names)
        if one is not None:
            test, other = one.test, (one.baseline.policy, one.baseline.n_action_steps)
            tested = (test.difference, *test.interval, one.pairs.n_pairs, one.corrected_p, test.p_value)
            cells |= zip(names, (*other, *tested), strict=True)
    return cells


def _paired_column(number: int, baseline: str) -> Column[Row]:
    prefix = f"{_ordinal(number)}_" if number else ""
    return Column(
        f"vs {baseline}",
        lambda row: _shown_difference(row[PAIRED][number] if number < len(row[PAIRED]) else None),
        name=f"{prefix}difference",
        rank=min(number, 1),
    )


def _shown_difference(one: Comparison | None) -> str:
    if one is None:
        return UNDEFINED
    p_value = one.corrected_p
    p = f"p<{SMALLEST_SHOWN_P}" if p_value < SMALLEST_SHOWN_P else f"p={p_value:.3f}"
    return f"{one.test.difference:+.2f}".replace("-0.00", "+0.00") + f" ({p})"


def _shown_chance(row: Row) -> str:
    chance = row[CHANCE]
    return (
        UNDEFINED if chance is None else rate(chance.rate) + ("†" if chance.source in BY_ARITHMETIC else "")
    )


def _paired_notes(rows: Sequence[Row]) -> Iterator[str]:
    found = [(row, one) for row in rows for one in row[PAIRED] if one is not None]
    if not found:
        return
    # In the order of the table's baselines, each of which is at the same place in all rows.
    numbers = {one.baseline.policy: row[PAIRED].index(one) for row, one in found}
    baselines = sorted(numbers, key=lambda baseline: numbers[baseline])
    columns = ", ".join(f"vs {baseline}" for baseline in baselines)
    yield (
        f"{columns}: difference of success once over the same episodes (run, seed); p of the exact "
        f"McNemar test, Holm-corrected over {count(len(found), 'comparison')} in this table."
    )
    if any(row[SUCCESS].n_runs > 1 for row, _ in found):
        yield (
            "p treats pairs of several runs as independent: it describes these trained policies, not "
            "training them again; for that, use the interval over the runs."
        )
    n_runs = {row.key: row[SUCCESS].n_runs for row in rows}
    for baseline in baselines:
        own = [(row.key, one.baseline) for row, one in found if one.baseline.policy == baseline]
        fewer = [
            f"{key} ({n_runs[other]} of {n_runs[key]} runs)"
            for key, other in own
            if n_runs[other] < n_runs[key]
        ]
        if fewer:
            yield (
                f"vs {baseline}: {some_of(fewer)} over the runs that {baseline} has, too; `--runs` gives it "
                "as many."
            )
        other_k = [
            f"{key} against K={other.n_action_steps}"
            for key, other in own
            if other.n_action_steps != key.n_action_steps
        ]
        if other_k:
            yield f"compared with {baseline} at another n_action_steps: {some_of(other_k)}."


def _chance_notes(rows: Sequence[Row]) -> Iterator[str]:
    found = [(row, chance) for row in rows if (chance := row[CHANCE]) is not None]
    if any(chance.source == "cue_blind" for _, chance in found):
        yield "chance: `cue_blind` as measured on the same task at the same n_action_steps."
    if any(chance.source in BY_ARITHMETIC for _, chance in found):
        yield (
            "† chance is 1/N for N candidates (by arithmetic where several are right), not measured: "
            "`cue_blind` has no result there at this n_action_steps."
        )
    missing = dict.fromkeys(
        f"{row.task} K={row.n_action_steps}"
        for row in rows
        if row[CHANCE] is None and row[EPISODES].n_episodes and _has_controls(row.task)
    )
    if missing:
        yield (
            f"chance is unknown for {some_of(missing)}: it has to be measured there; run `cue_blind` at the "
            "same n_action_steps."
        )
    # As in a run that is in progress.
    vague = dict.fromkeys(
        f"{row.key.place} [{low:.2f}, {high:.2f}]"
        for row, chance in found
        if chance.interval is not None
        for low, high in (chance.interval,)
        if high - low > VAGUE
    )
    if vague:
        yield (
            f"chance is imprecise for {some_of(vague)}: `cue_blind` has too few episodes there (95 % "
            "interval in brackets). The corrected score is computed from it."
        )
    for row, chance in found:
        success, highest = row[SUCCESS], chance.interval.high if chance.interval else chance.rate
        if row.policy == TOUR_POLICY and success.ci_low is not None and success.ci_low > highest:
            yield (
                f"{row.key.place}: `tour` reaches {success.success_once:.2f} where chance is "
                f"{chance.rate:.2f}. Success there can be reached by touching one candidate after another "
                "and is not by itself evidence of memory; use the first choice."
            )


def _has_controls(task: str) -> bool:
    """Whether chance can be measured by `cue_blind`; half of the official 90 tasks have no scripted arm."""
    spec = find_task(task)
    return spec is None or (bool(spec.oracle) and not spec.is_base)


PAIRED: Statistic[tuple[Comparison | None, ...]] = Statistic(
    estimate=lambda of: of.comparisons, cells=_paired_cells, column_of=_paired_column, notes=_paired_notes
)
CHANCE: Statistic[Chance | None] = Statistic(
    estimate=lambda of: of.chance,
    cells=lambda value: {
        "chance": None if value is None else value.rate,
        "chance_source": None if value is None else value.source,
    },
    columns=(Column("chance", _shown_chance, name="chance", rank=3, folds=True),),
    notes=_chance_notes,
)
CEILING: Statistic[float | None] = Statistic(
    estimate=lambda of: of.ceiling,
    cells=lambda value: {"ceiling": value},
    columns=(Column("ceiling", lambda row: rate(row[CEILING]), name="ceiling", rank=4, folds=True),),
)
CORRECTED: Statistic[float | None] = Statistic(
    estimate=lambda of: chance_corrected(
        of.success.success_once, chance=of.chance.rate if of.chance else None, ceiling=of.ceiling
    ),
    cells=lambda value: {"chance_corrected": value},
    columns=(Column("corrected", lambda row: rate(row[CORRECTED]), name="corrected", rank=5),),
)


def against_chance(row: Row) -> Comparison | None:
    """Return the comparison with the policy without the cue on the same episodes, where there is one."""
    return next((one for one in row[PAIRED] if one and one.baseline.policy == CHANCE_POLICY), None)
