"""The statistics of how an arm moved, what it waited for, and how old the observations were."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from vla_eval.motion import Motion
from vla_eval.records import EpisodeRecord
from vla_eval.results.comparison import Evidence
from vla_eval.results.printed_table import UNDEFINED, Column
from vla_eval.results.success_table import Row, Statistic


class Timing(NamedTuple):
    """Means over episodes; None where records do not say."""

    held_share: float | None = None  # of the control steps, those at which the arm held for want of an action
    mean_age_steps: float | None = None  # of the observation behind an executed action
    mean_delay_steps: float | None = None  # of an inference, where it varies


class Smoothness(NamedTuple):
    """How chunks join, means over the episodes in which there is something to measure."""

    border_jump: float | None = None  # jump at a border of chunks, as a multiple of the median step
    border_turn_jump: float | None = None  # likewise, of rotations
    jerk_m_s3: float | None = None


def _mean(records: Sequence[EpisodeRecord], value: Callable[[EpisodeRecord], float | None]) -> float | None:
    found = [one for record in records if (one := value(record)) is not None]
    return math.fsum(found) / len(found) if found else None


def _timing(of: Evidence) -> Timing:
    results = of.episodes.results

    def held(record: EpisodeRecord) -> float | None:
        if record.n_held_steps is None or record.n_steps is None:
            return None
        return record.n_held_steps / record.n_steps

    def delay(record: EpisodeRecord) -> float | None:
        return sum(record.delay_steps) / len(record.delay_steps) if record.delay_steps else None

    return Timing(_mean(results, held), _mean(results, lambda one: one.mean_age_steps), _mean(results, delay))


def _smoothness(of: Evidence) -> Smoothness:
    def of_motion(value: Callable[[Motion], float | None]) -> float | None:
        return _mean(of.episodes.results, lambda one: None if one.motion is None else value(one.motion))

    return Smoothness(
        of_motion(lambda one: _ratio(one.border_jump_m, one.median_step_m)),
        of_motion(lambda one: _ratio(one.border_jump_rad, one.median_step_rad)),
        of_motion(lambda one: one.jerk_m_s3),
    )


def _ratio(jump: float | None, step: float | None) -> float | None:
    return None if jump is None or not step else jump / step


def shown(value: float | None, form: str) -> str:
    """Return a number in a form; `—` for 0 and for what is not known."""
    return UNDEFINED if not value else format(value, form)


def _timing_notes(rows: Sequence[Row]) -> Iterator[str]:
    if any(row[TIMING].held_share for row in rows):
        yield (
            "held: share of the control steps at which no chunk had an action and the arm held still, the "
            "wait for the first chunk included."
        )


TIMING: Statistic[Timing] = Statistic(
    estimate=_timing,
    cells=lambda value: value._asdict(),
    columns=(
        Column("held", lambda row: shown(row[TIMING].held_share, ".2f"), name="held", rank=9),
        Column("age", lambda row: shown(row[TIMING].mean_age_steps, ".1f"), name="age", is_extra=True),
        Column("delay", lambda row: shown(row[TIMING].mean_delay_steps, ".1f"), name="delay", rank=10),
    ),
    notes=_timing_notes,
)
SMOOTHNESS: Statistic[Smoothness] = Statistic(
    estimate=_smoothness,
    cells=lambda value: value._asdict(),
    columns=(
        Column("jump", lambda row: shown(row[SMOOTHNESS].border_jump, ".2f"), name="jump", is_extra=True),
        Column(
            "turn jump",
            lambda row: shown(row[SMOOTHNESS].border_turn_jump, ".2f"),
            name="turn_jump",
            is_extra=True,
        ),
        Column("jerk m/s³", lambda row: shown(row[SMOOTHNESS].jerk_m_s3, ".1f"), name="jerk", is_extra=True),
    ),
)
