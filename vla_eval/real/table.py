"""The table of an evaluation on an arm: touched and picked, per stage and policy, as the paper has it."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from vla_eval.records import EpisodeRecord
from vla_eval.results.estimates import Share, p_above
from vla_eval.results.printed_table import UNDEFINED, Column, PrintedTable, p_text
from vla_eval.tasks.real_stages import CHANCE, COLORS, PAPER_EPISODES, STAGES, Rates, Stage, stage_of

PAPER = "π0.5 (paper)"
TOTAL = "Total"


class StageRow(NamedTuple):
    """A policy on a stage, on an arm or in the paper."""

    stage: Stage
    policy: str
    n_episodes: int
    n_errors: int | None
    touched: Share | None  # None: without an episode that has a result
    picked: Share | None
    by_color: tuple[Rates | None, ...]


def is_touched(record: EpisodeRecord) -> bool:
    """Whether the right cube was touched, whatever else was."""
    return record.target in (record.touched_candidates or ())


def is_picked(record: EpisodeRecord) -> bool:
    """Whether the right cube was picked."""
    return bool(record.success_once)


def stage_rows(records: Sequence[EpisodeRecord]) -> list[StageRow]:
    """Return a row per stage and policy that has an episode; errors are counted, and are in no rate."""
    rows, policies = [], sorted({one.policy for one in records})
    for stage in STAGES:
        on_stage = [one for one in records if stage_of(one.task) == stage]
        for policy in policies:
            own = [one for one in on_stage if one.policy == policy]
            if not own:
                continue
            results = [one for one in own if one.outcome != "error"]
            rows.append(
                StageRow(
                    stage=stage,
                    policy=policy,
                    n_episodes=len(results),
                    n_errors=len(own) - len(results),
                    touched=Share.counted(results, is_touched),
                    picked=Share.counted(results, is_picked),
                    by_color=tuple(_rates(results, color) for color in range(len(COLORS))),
                )
            )
    return rows


def paper_row(stage: Stage) -> StageRow:
    """Return the paper's row of a stage."""
    total = stage.paper[TOTAL]
    touched, picked = (Share(round(rate * PAPER_EPISODES), PAPER_EPISODES) for rate in total)
    return StageRow(
        stage=stage,
        policy=PAPER,
        n_episodes=PAPER_EPISODES,
        n_errors=None,
        touched=touched,
        picked=picked,
        by_color=tuple(stage.paper[color] for color in COLORS),
    )


def p_below(touched: Share) -> float:
    """Return the probability of at most so many touches of the right cube by an arm that guesses one.

    Source: one-sided exact binomial test.
    """
    return 1 - p_above(touched.n + 1, touched.of, CHANCE) if touched.n < touched.of else 1.0


COLUMNS: tuple[Column[StageRow], ...] = (
    Column("stage", lambda row: row.stage.name, is_number=False),
    Column("policy", lambda row: row.policy, is_number=False),
    Column("episodes", lambda row: str(row.n_episodes)),
    Column("errors", lambda row: UNDEFINED if row.n_errors is None else str(row.n_errors)),
    Column("is_touched", lambda row: _share(row.touched)),
    Column("is_picked", lambda row: _share(row.picked)),
    *(
        Column(color, lambda row, index=index: _pair(row.by_color[index]))  # type: ignore[misc]
        for index, color in enumerate(COLORS)
    ),
    Column("chance", lambda row: f"{CHANCE:.2f}"),
)


def real_table(records: Sequence[EpisodeRecord], *, with_paper: bool) -> PrintedTable:
    """Return the table of records; `with_paper`: the paper's rows beside."""
    rows = stage_rows(records)
    if with_paper:
        stages = {row.stage.name: row.stage for row in rows}.values()
        rows = [
            one
            for stage in stages
            for one in (*(row for row in rows if row.stage == stage), paper_row(stage))
        ]
    cells = [[column.cell(row) for column in COLUMNS] for row in rows]
    return PrintedTable(columns=COLUMNS, rows=cells, notes=tuple(_notes(rows)))


def _notes(rows: Sequence[StageRow]) -> Iterator[str]:
    yield (
        "is_touched: the right cube was touched, whichever was touched first; is_picked: it was picked. With "
        f"95 % Wilson intervals; {', '.join(COLORS)}: touched/picked. chance: of an arm that grasps one of "
        "the three cubes at random."
    )
    for row in rows:
        if row.touched is not None and (p := p_below(row.touched)) < 0.05:
            yield (
                f"{row.policy} on {row.stage.name}: {row.touched.n} of {row.touched.of} touched is below "
                f"chance ({p_text(p)}, exact binomial test, one-sided): it does not guess, or does not get "
                "to a cube."
            )
    if any(row.policy == PAPER for row in rows):
        yield (
            f"{PAPER}: the figures of its table, of {PAPER_EPISODES} episodes per stage, on another arm with "
            "other cameras; the intervals are ours."
        )


def _rates(results: Sequence[EpisodeRecord], color: int) -> Rates | None:
    own = [one for one in results if one.target == color]
    if not own:
        return None
    touched, picked = sum(map(is_touched, own)), sum(map(is_picked, own))
    return Rates(touched / len(own), picked / len(own))


def _share(share: Share | None) -> str:
    return UNDEFINED if share is None else str(share)


def _pair(rates: Rates | None) -> str:
    return UNDEFINED if rates is None else f"{rates.touched:.2f}/{rates.picked:.2f}"
