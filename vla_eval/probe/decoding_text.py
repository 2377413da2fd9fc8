"""What linear probes find in a memory: a table, sentences and JSON."""

from collections.abc import Sequence

from vla_eval.probe.decoding import Decoded
from vla_eval.probe.text_table import JsonRow, shown_rate
from vla_eval.results.printed_table import UNDEFINED, Column, PrintedTable, cells_of


def printed_decoding(found: Sequence[Decoded]) -> PrintedTable:
    """Return a row per policy and label: what its memory says at the response."""
    notes = [*decoding_sentences(found), *decoding_notes(found)]
    return PrintedTable(columns=_COLUMNS, rows=cells_of(_COLUMNS, found), notes=notes).folded()


def decoding_sentences(found: Sequence[Decoded]) -> list[str]:
    """Return a sentence for each policy and label that it can choose."""
    return [
        f"{one.policy} on {one.task}, K = {one.n_action_steps}: at the response a linear probe reads the "
        f"{one.label} from its memory in {one.acts.both + one.acts.knows} of {one.acts.n} episodes. Of these "
        f"it follows the cue in {one.acts.both}, of the other {one.acts.acts + one.acts.neither} in "
        f"{one.acts.acts}."
        for one in found
        if one.acts is not None
    ]


def decoding_notes(found: Sequence[Decoded]) -> list[str]:
    """Return what a reader of the table has to know."""
    if not found:
        return []
    return [
        "Linear probes (ridge regression) on the memory after an inference, each episode predicted by those "
        "of other seeds; from the frame: on the newest frame alone; chance: of the most frequent answer."
    ]


def decoding_json(found: Sequence[Decoded]) -> list[JsonRow]:
    """Return the curves as JSON."""
    return [
        {
            "task": one.task,
            "policy": one.policy,
            "n_action_steps": one.n_action_steps,
            "label": one.label,
            "chance": one.chance,
            "response_step": one.response_step,
            "points": [
                {
                    "step": point.step,
                    "n_episodes": point.memory.of,
                    "decoded": point.memory.rate,
                    "decoded_low": point.memory.interval.low,
                    "decoded_high": point.memory.interval.high,
                    "decoded_from_frame": None if point.frame is None else point.frame.rate,
                }
                for point in one.steps
            ],
            "acts": None if one.acts is None else one.acts._asdict(),
        }
        for one in found
    ]


def _at_response(one: Decoded) -> str:
    point = next((point for point in one.steps if point.step >= one.response_step), one.steps[-1])
    return shown_rate(point.memory.rate, point.memory.interval)


def _frame_at_response(one: Decoded) -> str:
    point = next((point for point in one.steps if point.step >= one.response_step), one.steps[-1])
    return UNDEFINED if point.frame is None else shown_rate(point.frame.rate, point.frame.interval)


def _step(one: Decoded) -> str:
    return str(
        next((point.step for point in one.steps if point.step >= one.response_step), one.steps[-1].step)
    )


_COLUMNS: tuple[Column[Decoded], ...] = (
    Column("task", lambda one: one.task, is_number=False, folds=True),
    Column("policy", lambda one: one.policy, is_number=False, folds=True),
    Column("K", lambda one: str(one.n_action_steps), folds=True),
    Column("in the memory", lambda one: one.label, is_number=False),
    Column("step", _step),
    Column("decoded", _at_response),
    Column("from the frame", _frame_at_response),
    Column("chance", lambda one: f"{one.chance:.2f}"),
    Column("knows, acts", lambda one: UNDEFINED if one.acts is None else str(one.acts.both)),
    Column("knows only", lambda one: UNDEFINED if one.acts is None else str(one.acts.knows)),
    Column("acts only", lambda one: UNDEFINED if one.acts is None else str(one.acts.acts)),
    Column("neither", lambda one: UNDEFINED if one.acts is None else str(one.acts.neither)),
)
