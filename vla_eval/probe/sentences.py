"""A probe in words: per policy one sentence, and notes on the controls."""

from collections.abc import Iterator, Sequence

from vla_eval.probe.grid import ORACLE
from vla_eval.probe.interventions import INTERVENTIONS
from vla_eval.probe.mistakes import MISTAKES
from vla_eval.probe.retention import HalfLife
from vla_eval.probe.retention_curves import Retention
from vla_eval.probe.table import ProbeRow, ProbeTable
from vla_eval.probe.text_table import error_notes
from vla_eval.probe.worlds import AS_DRAWN, CONTROLS, CONTROLS_OF_ONE, SWAPS, WITHOUT_MEMORY
from vla_eval.results.estimates import Share

LEAST_MISTAKES = 5  # with fewer, their kinds say nothing


def sentences(table: ProbeTable) -> list[str]:
    """Return one sentence per task, policy and n_action_steps."""
    keys = dict.fromkeys((row.task, row.policy, row.n_action_steps) for row in table.rows)
    return [_sentence(table, *key) for key in keys]


def _sentence(table: ProbeTable, task: str, policy: str, k: int) -> str:
    rows = [row for row in table.rows if (row.task, row.policy, row.n_action_steps) == (task, policy, k)]
    said = [clause for row in rows if (clause := _clause(row)) is not None]
    said += [
        _half_life(curve)
        for curve in table.retention
        if (curve.task, curve.policy, curve.n_action_steps) == (task, policy, k)
    ]
    said += filter(None, [_forgotten_first(rows)])
    return f"{policy} on {task}, K = {k}: {'; '.join(said) or 'no episode has a result'}."


def _clause(row: ProbeRow) -> str | None:
    if row.intervention == WITHOUT_MEMORY:
        return "keeps no memory that could be changed"
    if row.swap is not None:
        what = "both orders" if row.intervention == "order" else "the cue in both worlds"
        after = f" after a delay of {row.level} steps" if row.intervention == "delay_swap" else ""
        return f"follows {what}{after} in {_of(row.swap.warranted_choice)} pairs{_of_pairs(row)}"
    if row.followed is None or row.intervention in SWAPS:
        return None
    if row.intervention == AS_DRAWN:
        where = "follows the cue in"
    elif row.intervention == "mask":
        where = f"{_hidden(row)} in"
    else:
        where = INTERVENTIONS[row.intervention].clause.format(level=row.level)
    chance = "" if row.chance is None else f" (chance {row.chance * row.followed.of:.0f})"
    idle = f", touching nothing in {row.n_without_choice}" if row.n_without_choice else ""
    put_in = f", and that memory in {_of(row.followed_memory)}" if row.followed_memory else ""
    return f"{where} {_of(row.followed)}{chance}{put_in}{idle}{_over_delay(row)}"


def _over_delay(row: ProbeRow) -> str:
    if row.over_delay is None:
        return ""
    difference, (low, high) = row.over_delay.difference, row.over_delay.interval
    after = f"after a delay of {row.over_delay.delay_steps} steps"
    return f", {difference:+.2f} [{low:+.2f}, {high:+.2f}] of the share {after}"


def _forgotten_first(rows: Sequence[ProbeRow]) -> str | None:
    """Return the kinds of mistakes at the shortest delay with enough of them to tell."""
    known = [
        (row.delay_steps or 0, row.mistakes)
        for row in rows
        if row.intervention in ("none", "delay") and row.mistakes is not None
    ]
    for delay_steps, found in sorted(known, key=lambda one: one[0]):
        if found.n_mistakes >= LEAST_MISTAKES:
            kinds = sorted(MISTAKES, key=lambda kind: found.counts[kind], reverse=True)
            counts = [f"{kind} in {found.counts[kind]}" for kind in kinds if found.counts[kind]]
            by_chance = found.counts["place"] and found.expected_place is not None
            beside = f" (place in {found.expected_place:.1f} by chance)" if by_chance else ""
            return (
                f"what is forgotten first, of {found.n_mistakes} mistakes after a delay of {delay_steps} "
                f"steps: {', '.join(counts)}{beside}"
            )
    return None


def _hidden(row: ProbeRow) -> str:
    where = {"cue": "the cue", "elsewhere": "as much of the image beside it"}
    return f"with {where.get(str(row.level), 'its place in the delay')} hidden"


def _of(share: Share) -> str:
    return f"{share.n} of {share.of}"


def _of_pairs(row: ProbeRow) -> str:
    """Return what independent choices without the cue would give; a constant choice gives 0."""
    if row.swap is None or row.chance is None:
        return ""
    return f" (chance at most {row.chance**2 * row.n_pairs:.0f})"


def _half_life(curve: Retention) -> str:
    of = " of following it in both worlds" if curve.of == "warranted_choice" else ""
    if curve.half_life is None:
        return f"no half-life{of}, since at the shortest delay this is not more frequent than by chance"
    return f"half-life{of} {half_life_text(curve.half_life)}"


def half_life_text(half: HalfLife) -> str:
    """Return a half-life with its interval: `187 steps [160 to more than 320]`."""
    if half.steps is None and half.interval.low is None:
        return f"more than {half.longest_delay} steps"
    ends = " to ".join(_steps(end, half) for end in half.interval)
    return f"{_steps(half.steps, half)} steps [{ends}]"


def _steps(steps: float | None, half: HalfLife) -> str:
    return f"more than {half.longest_delay}" if steps is None else f"{steps:.0f}"


def notes(table: ProbeTable) -> list[str]:
    """Return the notes that a reader of the table needs, errors and failed controls included."""
    found = [
        *_columns(table.rows),
        *_shown_after(table.rows),
        *_failed_controls(table.rows),
        *_chunk_and_phase(table.rows),
    ]
    return [*found, *error_notes(table.n_errors)]


def _shown_after(rows: Sequence[ProbeRow]) -> Iterator[str]:
    """Say where the cue is seen again after a change of the memory, so that this is no clean change."""
    found = dict.fromkeys((row.task, row.n_action_steps, row.n_cue_frames_after) for row in rows)
    for task, k, n_frames in found:
        if n_frames:
            yield (
                f"{task}, K = {k}: a policy that reads every frame is shown {n_frames} frames of the cue "
                "after its memory is changed, together with the first frame of the response. A smaller "
                "n_action_steps shows fewer; 1 shows none."
            )


def _columns(rows: Sequence[ProbeRow]) -> Iterator[str]:
    if any(row.swap for row in rows):
        yield (
            "sensitivity: share of pairs whose choice differs between the two worlds (for sets: the items "
            "touched; Rotate: the final angle; other tasks without candidates: the trajectory); "
            "warranted: the cue is followed in both worlds; value: mean success of both worlds; reliable: "
            "success in both."
        )
    if any(row.followed_memory for row in rows):
        yield (
            "memory: share of episodes whose first choice is right by the memory that was put in, of those "
            "in which the cue makes another one right."
        )
    if any(row.kept for row in rows):
        yield "kept: items that are remembered, corrected for guessing."
    if any(row.over_delay for row in rows):
        yield (
            "over delay: by how much more the cue is followed in another appearance than after the longest "
            "delay."
        )
    yield (
        "Intervals at 95 %: Wilson; of shares left, half-lives, items kept and differences, bootstrap over "
        "seeds."
    )
    if any(row.p_value is not None for row in rows):
        yield (
            "p: for swaps, exact sign test of following both cues against choosing each world's candidate in "
            "the other; else exact McNemar test against the world as drawn. Holm's correction over the table."
        )
    if any(row.policy in (*CONTROLS, *CONTROLS_OF_ONE) for row in rows):
        yield (
            "Scripted controls read the true state and no image: a blank cue and a reset take nothing from "
            "them."
        )


def _failed_controls(rows: Sequence[ProbeRow]) -> list[str]:
    return [
        f"the oracle follows the cue in {_of(row.swap.warranted_choice)} pairs of {row.task}, "
        f"{row.label}: in the others even an arm that knows the answer fails."
        for row in rows
        if row.policy == ORACLE
        and row.swap is not None
        and row.swap.warranted_choice.n < row.swap.warranted_choice.of
    ]


def _chunk_and_phase(rows: Sequence[ProbeRow]) -> Iterator[str]:
    """Name the worlds in which the oracle succeeds less at a larger K: there, chunks explain a drop."""
    oracles = [(row, row.success) for row in rows if row.policy == ORACLE and row.success is not None]
    for row, success in oracles:
        same = [
            (one.n_action_steps, found)
            for one, found in oracles
            if (one.task, one.label) == (row.task, row.label) and one.n_action_steps < row.n_action_steps
        ]
        k, best = max(same, key=lambda one: one[1].rate, default=(0, success))
        if success.interval.high < best.interval.low:
            late = f" ({row.inferences.n_late} steps late)" if row.inferences else ""
            yield (
                f"{row.task}, {row.label}: at K = {row.n_action_steps}{late} the oracle, which forgets "
                f"nothing, succeeds in {_of(success)} instead of {_of(best)} at K = {k}: chunk and phase "
                "explain a drop of this size, not memory."
            )
