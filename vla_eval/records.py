"""One episode as one line of JSON: the unit that is stored, resumed, counted and reported.

A record holds nothing that depends on the machine's clock or on which worker ran it: the same
episode gives the same line. Wall-clock times are kept apart (`EpisodeTiming`).
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, NamedTuple, Self

from vla_eval.errors import RunFolderError
from vla_eval.motion import Motion
from vla_eval.strict.bounds import Count, Distance, Positive, Rate, Seconds
from vla_eval.strict.json_text import Source, as_dataclass, read_json, read_version

RECORD_VERSION = 2
"""Raise it when a field changes its meaning; readers refuse versions they do not know. 2: `finished`."""
READ_VERSIONS = (1, RECORD_VERSION)

Outcome = Literal["success", "failure", "finished", "error"]

LATER_FIELDS = frozenset(
    {
        *("chance_success", "target_place", "first_choice_place", "tcp_reach_m"),
        *("right_candidates", "touched_candidates", "candidate_places", "final_turn_rad"),
        *("n_held_steps", "mean_age_steps", "delay_steps", "motion", "candidate_names"),
    }
)
"""Fields that records of earlier versions of this program do not have."""


REMEDY = (
    "The file was changed by something else; restore it, remove the line so that the episode is run again, "
    "or start a new run folder."
)
MADE_REMEDY = (
    "Nothing was stored. Fix the environment or the policy that gave these values; a policy's file with "
    "such a name has to be renamed."
)


class EpisodeKey(NamedTuple):
    """What makes an episode of a run folder unique."""

    task: str
    policy: str
    n_action_steps: Positive
    run: Count
    seed: Count


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeError:
    """Why an episode has no result."""

    kind: str  # class name of the exception, or `WorkerCrashed`, `StepTimeout`, `InferenceTimeout` …
    stage: str  # `setup`, `reset`, `step` or `inference`
    message: str  # what was expected, found, where, next action
    details: str | None = None  # the traceback, or what else helps to find the cause; may be long


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRecord:
    """The result of one episode. A field that has no meaning for it is None, never 0.

    Attributes:
        outcome: `success` if the success rule held at any step, `failure` if it never did, `finished` in a
            task without such a rule, `error` if the episode could not be run to its end. An error is never
            a failure.
        success_once / success_at_end: at any step / at the last step; None for an error and in a task
            without a success rule, and success_at_end also where the run stops at the first success.
        success_step: control steps executed when the success rule first held.
        n_steps: control steps executed.
        target, n_candidates, first_choice, first_choice_success, n_wrong_choices: which candidate was
            right, how many there were, which one was touched first and whether that was right, and how
            many different wrong ones were touched; None for a task without candidates.
            first_choice_success is False if no candidate was touched; target is None where several are.
        target_place, first_choice_place: where the right candidate and the first one touched lay, counted
            from the robot's right; None as above, and where an environment does not tell.
        tcp_reach_m: how far the tool centre point ever was from where it began, straight; None in records of
            earlier versions.
        right_candidates, touched_candidates: the right ones, in the order shown, and those touched, in the
            order of first touch; None as above, and in records of earlier versions.
        candidate_places: where each candidate lay, counted as above.
        candidate_names: what the candidates are, where that is not a fact of the task (`env.meshes`).
        final_turn_rad: how far the object was turned at the end, counterclockwise seen from above; None in
            tasks that do not ask for it.
        chance_success: success rate of a perfect arm that ignores the cue, with the arguments of this
            episode; None where it has to be measured.
        episode_return: sum of rewards.
        n_inferences: calls of the policy; n_frames: observations given to it.
        n_clipped_steps: steps whose action went beyond the action space and was clipped.
        n_held_steps: steps at which no chunk had an action and the arm held still, the wait for the first
            chunk included.
        mean_age_steps: how old the observation behind an executed action was, mean over the steps that were
            not held.
        delay_steps: control steps that each inference took, where they differ.
        motion: how smooth the arm's way was; None without the pose of a tool centre point.
        trajectory_sha256: digest of all executed actions and states: equal digests, equal episodes.
        error: the cause, for an error only.
    """

    task: str
    policy: str
    n_action_steps: Positive
    run: Count
    seed: Count
    outcome: Outcome
    success_once: bool | None = None
    success_at_end: bool | None = None
    success_step: Positive | None = None
    n_steps: Positive | None = None
    target: Count | None = None
    n_candidates: Positive | None = None
    first_choice: Count | None = None
    first_choice_success: bool | None = None
    n_wrong_choices: Count | None = None
    chance_success: Rate | None = None
    episode_return: float | None = None
    n_inferences: Positive | None = None
    n_frames: Count | None = None
    n_clipped_steps: Count | None = None
    trajectory_sha256: str | None = None
    target_place: Count | None = None
    first_choice_place: Count | None = None
    tcp_reach_m: Distance | None = None
    right_candidates: tuple[Count, ...] | None = None
    touched_candidates: tuple[Count, ...] | None = None
    candidate_places: tuple[Count, ...] | None = None
    candidate_names: tuple[str, ...] | None = None
    final_turn_rad: float | None = None
    n_held_steps: Count | None = None
    mean_age_steps: Distance | None = None
    delay_steps: tuple[Count, ...] | None = None
    motion: Motion | None = None
    error: EpisodeError | None = None

    @property
    def key(self) -> EpisodeKey:
        """The identity of the episode within its run folder."""
        return EpisodeKey(self.task, self.policy, self.n_action_steps, self.run, self.seed)

    def to_json(self) -> str:
        """Return the record as one line of JSON, without the line's end."""
        data = {"record_version": RECORD_VERSION, **asdict(self)}
        if self.candidate_names is None:
            del data["candidate_names"]  # so that earlier versions of this program read the record
        return json.dumps(data, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, line: str | bytes, *, where: str) -> Self:
        """Read back what `to_json` wrote; `where`: file and line number, for the message.

        Raises:
            RunFolderError: the line is not a record, one of another version, or one that cannot be true.
        """
        source = Source(where=where, what="an episode record", remedy=REMEDY, error=RunFolderError)
        data = read_json(line, source)
        read_version(data, "record_version", READ_VERSIONS, source)
        return cls._from_data(data, source)

    def check(self, *, where: str) -> None:
        """Raise `RunFolderError` if the record, made by `where`, would not survive a round trip."""
        source = Source(where=where, what="a sound episode record", remedy=MADE_REMEDY, error=RunFolderError)
        self._from_data(asdict(self), source)

    @classmethod
    def _from_data(cls, data: dict[str, Any], source: Source) -> Self:  # Any: JSON
        for name in REQUIRED_FIELDS:
            if name not in data:
                raise source.refuse(f"no field '{name}'", "it is missing")
        record = as_dataclass(cls, data, source)
        rule = broken_rule(record)
        if rule is not None:
            found = ", ".join(f"{name} {getattr(record, name)!r:.80}" for name in rule.fields)
            raise source.refuse(found, f"expected {rule.expected}")
        return record


REQUIRED_FIELDS = tuple(field.name for field in fields(EpisodeRecord) if field.name not in LATER_FIELDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeTiming:
    """Wall-clock seconds of one episode and its parts; kept next to the record, never part of it."""

    key: EpisodeKey
    total_seconds: Seconds
    reset_seconds: Seconds
    step_seconds: Seconds
    inference_seconds: Seconds
    kind: str | None = None  # name of the kind of machine that ran it; None: that of the run's environment

    def to_json(self) -> str:
        """Return the timing as one line of JSON, without the line's end."""
        data = {**asdict(self), "key": self.key._asdict()}
        if self.kind is None:
            del data["kind"]  # as in files of earlier versions
        return json.dumps(data)


# What must hold of a record beyond the types and ranges of its fields: which values go together.

MAX_NAME = 255  # characters, as in the name of a file

OF_ANY_EPISODE = {*EpisodeKey._fields, "outcome", "error"}
RESULT_FIELDS = tuple(field.name for field in fields(EpisodeRecord) if field.name not in OF_ANY_EPISODE)


class Rule(NamedTuple):
    """One thing that must hold; what is unknown (None) breaks no rule unless it says so."""

    fields: tuple[str, ...]
    expected: str
    holds: Callable[[EpisodeRecord], bool]


def _not_more(name: str, limit: str, *, less: bool = False) -> Rule:
    def holds(record: EpisodeRecord) -> bool:
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
    def holds(record: EpisodeRecord) -> bool:
        return getattr(record, name) is None or getattr(record, other) is not None

    return Rule((name, other), f"no {name} where {other} is null", holds)


def _are_distinct_candidates(name: str) -> Rule:
    def holds(record: EpisodeRecord) -> bool:
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


def _choice_is_right(record: EpisodeRecord) -> bool:
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
        "success_once true for the outcome 'success', false for 'failure' and null for 'finished'",
        lambda one: one.success_once is {"success": True, "failure": False}.get(one.outcome),
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
    _not_more("n_held_steps", "n_steps"),
    _not_more("mean_age_steps", "n_steps"),
    Rule(
        ("n_inferences", "delay_steps"),
        "one delay per inference",
        lambda one: one.delay_steps is None or len(one.delay_steps) == one.n_inferences,
    ),
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
    Rule(
        ("n_candidates", "candidate_names"),
        "a name of its own for each candidate",
        lambda one: (
            one.candidate_names is None
            or (len({*one.candidate_names}) == one.n_candidates and all(map(is_name, one.candidate_names)))
        ),
    ),
)


def broken_rule(record: EpisodeRecord) -> Rule | None:
    """Return the first rule that a record breaks; None if it is sound."""
    rules = (*ALWAYS, *(OF_AN_ERROR if record.outcome == "error" else OF_A_RESULT))
    return next((rule for rule in rules if not rule.holds(record)), None)
