"""One episode as one line of JSON: the unit that is stored, resumed, counted and reported.

A record holds nothing that depends on the machine's clock or on which worker ran it: the same
episode gives the same line. Wall-clock times are kept apart (`EpisodeTiming`).
"""

import json
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple, Self

from vla_eval.errors import RunFolderError

RECORD_VERSION = 1
"""Raise it when a field changes its meaning; readers refuse versions they do not know."""

Outcome = Literal["success", "failure", "error"]


class EpisodeKey(NamedTuple):
    """What makes an episode of a run folder unique."""

    task: str
    policy: str
    n_action_steps: int
    run: int
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeError:
    """Why an episode has no result.

    Attributes:
        kind: class name of the exception, or `WorkerCrashed`, `StepTimeout`, `InferenceTimeout` …
        stage: `setup`, `reset`, `step` or `inference`.
        message: what was expected, found, where, next action.
        details: the traceback, or what else helps to find the cause; may be long.
    """

    kind: str
    stage: str
    message: str
    details: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRecord:
    """What came of one episode. A field that has no meaning for it is None, never 0.

    Attributes:
        outcome: `success` if the success rule held at any step, `failure` if it never did, `error` if
            the episode could not be run to its end. An error is never a failure.
        success_once / success_at_end: at any step / at the last step; None for an error, and
            success_at_end also where the run stops at the first success.
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
        chance_success: success rate of a perfect arm that ignores the cue, with the arguments of this
            episode; None where it has to be measured.
        episode_return: sum of rewards.
        n_inferences: calls of the policy; n_frames: observations given to it.
        n_clipped_steps: steps whose action went beyond the action space and was clipped.
        trajectory_sha256: digest of all executed actions and states: equal digests, equal episodes.
        error: the cause, for an error only.
    """

    task: str
    policy: str
    n_action_steps: int
    run: int
    seed: int
    outcome: Outcome
    success_once: bool | None = None
    success_at_end: bool | None = None
    success_step: int | None = None
    n_steps: int | None = None
    target: int | None = None
    n_candidates: int | None = None
    first_choice: int | None = None
    first_choice_success: bool | None = None
    n_wrong_choices: int | None = None
    chance_success: float | None = None
    episode_return: float | None = None
    n_inferences: int | None = None
    n_frames: int | None = None
    n_clipped_steps: int | None = None
    trajectory_sha256: str | None = None
    target_place: int | None = None
    first_choice_place: int | None = None
    tcp_reach_m: float | None = None
    error: EpisodeError | None = None

    @property
    def key(self) -> EpisodeKey:
        """The identity of the episode within its run folder."""
        return EpisodeKey(self.task, self.policy, self.n_action_steps, self.run, self.seed)

    def to_json(self) -> str:
        """Return the record as one line of JSON, without the line's end."""
        data = {"record_version": RECORD_VERSION, **asdict(self)}
        return json.dumps(data, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, line: str, *, where: str) -> Self:
        """Read a record back.

        Args:
            line: what `to_json` wrote.
            where: file and line number, for the message.

        Raises:
            RunFolderError: the line is no record, or one of another version.
        """
        try:
            data: dict[str, Any] = json.loads(line)
            version = data.pop("record_version")
            if version != RECORD_VERSION:
                raise RunFolderError(
                    f"{where}: record version {version}, this program reads version {RECORD_VERSION}. "
                    f"Report it with the version of mikasa-vla-eval that wrote it (see run.json)."
                )
            error = data.pop("error")
            return cls(**data, error=EpisodeError(**error) if error else None)
        except (ValueError, KeyError, TypeError, AttributeError) as exc:
            raise RunFolderError(
                f"{where}: expected an episode record, found {line[:80]!r} ({exc}). "
                f"The file was changed by something else; restore it or start a new run folder."
            ) from exc


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeTiming:
    """Wall-clock seconds of one episode; kept beside the record, never part of it."""

    key: EpisodeKey
    total_seconds: float
    reset_seconds: float
    step_seconds: float
    inference_seconds: float
