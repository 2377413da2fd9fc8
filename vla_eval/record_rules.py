"""What must hold of an episode's record beyond types and ranges: which values go together.

Knows nothing of files. Types and ranges are those of the fields' annotations.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from vla_eval.records import EpisodeRecord

MAX_NAME = 255  # characters, as in the name of a file

RESULT_FIELDS = (
    *("success_once", "success_at_end", "success_step", "n_steps", "target", "n_candidates", "first_choice"),
    *("first_choice_success", "n_wrong_choices", "chance_success", "episode_return", "n_inferences"),
    *(
        "n_frames",
        "n_clipped_steps",
        "trajectory_sha256",
        "target_place",
        "first_choice_place",
        "tcp_reach_m",
        "right_candidates",
        "touched_candidates",
        "candidate_places",
        "final_turn_rad",
    ),
)


class Rule(NamedTuple):
    """One thing that must hold; what is unknown (None) breaks no rule unless it says so."""

    fields: tuple[str, ...]
    expected: str
    holds: Callable[["EpisodeRecord"], bool]


def _not_more(name: str, limit: str, *, less: bool = False) -> Rule:
    def holds(record: "EpisodeRecord") -> bool:
        value, most = getattr(record, name), getattr(record, limit)
        return value is None or most is None or value < most or (value == most and not less)

    return Rule((name, limit), f"{name} {'<' if less else '≤'} {limit}", holds)


def _absent_of_an_error(name: str) -> Rule:
    return Rule(
        ("outcome", name),
        f"{name} null: an error has no result",
        lambda record: getattr(record, name) is None,
    )


def _goes_with(name: str, other: str) -> Rule:
    def holds(record: "EpisodeRecord") -> bool:
        return getattr(record, name) is None or getattr(record, other) is not None

    return Rule((name, other), f"no {name} where {other} is null", holds)


def _are_distinct_candidates(name: str) -> Rule:
    def holds(record: "EpisodeRecord") -> bool:
        indices, n_candidates = getattr(record, name), record.n_candidates or 0
        return indices is None or (
            len(set(indices)) == len(indices) and all(index < n_candidates for index in indices)
        )

    return Rule((name, "n_candidates"), f"{name} different from each other, each < n_candidates", holds)


def _only(candidate: int | None) -> tuple[int, ...]:
    return () if candidate is None else (candidate,)


def _is_permutation(places: tuple[int, ...], n_candidates: int | None) -> bool:
    return n_candidates is not None and sorted(places) == list(range(n_candidates))


def is_name(text: str) -> bool:
    """Whether this can be a task's or policy's name: part of a file's name, in one line."""
    return 0 < len(text) <= MAX_NAME and text.isprintable() and not {"/", "\\"} & set(text)


def is_task_id(text: str) -> bool:
    """Whether this can be a task's id: a name, or a namespace and a name with `/` between."""
    return len(text) <= MAX_NAME and text.count("/") <= 1 and all(map(is_name, text.split("/")))


_NAME = f"1 to {MAX_NAME} printable characters without '/' and '\\'"


def _choice_is_right(record: "EpisodeRecord") -> bool:
    """Whether `first_choice_success` is what target and first choice say."""
    if record.first_choice_success is None:
        return True
    if record.first_choice is None:
        return not record.first_choice_success
    return record.target is None or record.first_choice_success == (record.first_choice == record.target)


ALWAYS = (
    Rule(
        ("task",),
        f"a name of {_NAME}, or a namespace, '/' and a name",
        lambda record: is_task_id(record.task),
    ),
    Rule(("policy",), f"a name of {_NAME}", lambda record: is_name(record.policy)),
    Rule(
        ("outcome", "error"),
        "an error with the outcome 'error', and with no other",
        lambda one: (one.outcome == "error") == (one.error is not None),
    ),
)
OF_AN_ERROR = tuple(_absent_of_an_error(name) for name in RESULT_FIELDS)
OF_A_RESULT = (
    Rule(
        ("outcome", "success_once"),
        "success_once true for the outcome 'success' and false for 'failure'",
        lambda one: one.success_once is (one.outcome == "success"),
    ),
    Rule(
        ("success_once", "success_at_end"),
        "success_at_end true only where success_once is",
        lambda one: bool(one.success_once) or not one.success_at_end,
    ),
    Rule(
        ("success_once", "success_step"),
        "success_step null where success_once is false",
        lambda one: bool(one.success_once) or one.success_step is None,
    ),
    _not_more("success_step", "n_steps"),
    _not_more("n_inferences", "n_steps"),
    _not_more("n_clipped_steps", "n_steps"),
    _not_more("target", "n_candidates", less=True),
    _not_more("first_choice", "n_candidates", less=True),
    _not_more("n_wrong_choices", "n_candidates"),
    *(_goes_with(name, "n_candidates") for name in ("target", "first_choice", "n_wrong_choices")),
    _goes_with("target_place", "target"),
    _goes_with("first_choice_place", "first_choice"),
    Rule(
        ("target", "first_choice", "first_choice_success"),
        "first_choice_success true where the first choice is the target, false where it is not or is null",
        _choice_is_right,
    ),
    *(_are_distinct_candidates(name) for name in ("right_candidates", "touched_candidates")),
    Rule(
        ("first_choice", "touched_candidates"),
        "the first choice first among those touched",
        lambda one: one.touched_candidates is None or one.touched_candidates[:1] == _only(one.first_choice),
    ),
    Rule(
        ("target", "right_candidates"),
        "the target as the only right candidate",
        lambda one: None in (one.target, one.right_candidates) or one.right_candidates == _only(one.target),
    ),
    Rule(
        ("n_candidates", "candidate_places"),
        "a place of its own for each candidate",
        lambda one: one.candidate_places is None or _is_permutation(one.candidate_places, one.n_candidates),
    ),
)


def broken_rule(record: "EpisodeRecord") -> Rule | None:
    """Return the first rule that a record breaks; None if it is sound."""
    for rule in ALWAYS:
        if not rule.holds(record):
            return rule
    for rule in OF_AN_ERROR if record.outcome == "error" else OF_A_RESULT:
        if not rule.holds(record):
            return rule
    return None


def shown_fields(record: "EpisodeRecord", rule: Rule) -> str:
    """Return `outcome 'failure', success_once True` for a message."""
    return ", ".join(f"{name} {getattr(record, name)!r:.80}" for name in rule.fields)
