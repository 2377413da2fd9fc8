"""What the loop (`rollout`) keeps of a running episode: checks, counts, the digest, in the end the record."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from vla_eval.chunking import ChunkingSettings, ChunkingSpec, Executed
from vla_eval.core import ActionChunk, EpisodeStart, FloatArray, StepResult
from vla_eval.errors import InvalidActionError, MissingInstructionError, SimulationError, SpecMismatchError
from vla_eval.motion import HELD, motion_of
from vla_eval.records import EpisodeRecord
from vla_eval.specs import ActionSpec, EnvSpec, PolicySpec
from vla_eval.task_state import TaskStatus

TCP_POSE = "tcp_pose"  # the state that is the pose of the tool centre point: m, then a wxyz quaternion


@dataclass(slots=True, kw_only=True)
class EpisodeLog:
    """Counts and digest of one episode."""

    start: EpisodeStart  # the episode
    status: TaskStatus  # what the task said last
    # the poses of the tool centre point; none if that is not a state of the environment
    tcp_poses: list[FloatArray]
    # of each control step, the step of the observation behind its action, or `HELD`
    inferred_at_steps: list[int] = field(default_factory=list)
    n_steps: int = 0  # control steps executed
    success_step: int | None = None  # control steps executed when the success rule first held
    episode_return: float = 0.0
    n_inferences: int = 0
    last_inference_step: int = -1  # of the policy; -1 before the first one
    n_frames: int = 0
    n_clipped_steps: int = 0
    digest: "hashlib._Hash" = field(default_factory=hashlib.sha256)

    @classmethod
    def begin(cls, start: EpisodeStart, reset: StepResult) -> Self:
        """Start the log of an episode from its reset result."""
        log = cls(start=start, status=reset.status, tcp_poses=_tcp_pose(reset))
        log._digest_state(reset)
        return log

    def note_inference(self, *, n_frames: int) -> None:
        """Count one call of the policy that was given so many observations."""
        self.n_inferences += 1
        self.last_inference_step = self.n_steps
        self.n_frames += n_frames

    def note_step(
        self, executed: Executed | None, action: FloatArray, result: StepResult, action_spec: ActionSpec
    ) -> None:
        """Account for one control step by the action (A,) asked for, where it is from, and its result."""
        self.n_steps += 1
        self._check_finite(result)
        self.status = result.status
        self.tcp_poses += _tcp_pose(result)
        self.inferred_at_steps.append(HELD if executed is None else executed.inferred_at_step)
        self.episode_return += result.reward
        bounds = zip(action.tolist(), action_spec.low, action_spec.high, strict=True)
        self.n_clipped_steps += not all(low <= number <= high for number, low, high in bounds)
        self.digest.update(np.ascontiguousarray(action, dtype="<f4").tobytes())
        self._digest_state(result)
        if result.status.success and self.success_step is None:
            self.success_step = self.n_steps

    def is_over(self, *, steps_after_success: int | None) -> bool:
        """Whether the episode ends here, so many steps after its first success (None: never for that)."""
        is_won = (
            steps_after_success is not None
            and self.success_step is not None
            and self.n_steps - self.success_step >= steps_after_success
        )
        return is_won or self.status.fail or self.status.is_over or self.n_steps >= self.start.horizon_steps

    def record(
        self,
        policy: str,
        n_action_steps: int,
        *,
        stops_at_success: bool,
        delay_steps: Sequence[int] | None,
        control_hz: float,
    ) -> EpisodeRecord:
        """Return the record of the finished episode; one that stops at its first success has no known end.

        `delay_steps`: of each inference, where that differs.
        """
        status, succeeded = self.status, self.success_step is not None
        ages = [step - at for step, at in enumerate(self.inferred_at_steps) if at != HELD]
        has_candidates = status.n_candidates > 0
        has_end = status.has_success and not (stops_at_success and succeeded)
        return EpisodeRecord(
            task=self.start.task,
            policy=policy,
            n_action_steps=n_action_steps,
            run=self.start.run,
            seed=self.start.seed,
            outcome=("success" if succeeded else "failure") if status.has_success else "finished",
            success_once=succeeded if status.has_success else None,
            success_at_end=status.success if has_end else None,
            success_step=self.success_step,
            n_steps=self.n_steps,
            target=status.target,
            n_candidates=status.n_candidates if has_candidates else None,
            first_choice=status.first_choice,
            first_choice_success=status.first_choice in status.right_first_choices
            if has_candidates
            else None,
            n_wrong_choices=status.n_wrong_choices if has_candidates else None,
            chance_success=status.chance_success,
            episode_return=self.episode_return,
            n_inferences=self.n_inferences,
            n_frames=self.n_frames,
            n_clipped_steps=self.n_clipped_steps,
            trajectory_sha256=self.digest.hexdigest(),
            target_place=_place(status, status.target),
            first_choice_place=_place(status, status.first_choice),
            tcp_reach_m=self._tcp_reach_m,
            right_candidates=status.right_candidates if has_candidates else None,
            touched_candidates=status.touched_candidates if has_candidates else None,
            candidate_places=status.candidate_places or None,
            candidate_names=status.candidate_names or None,
            final_turn_rad=status.turned_rad,
            n_held_steps=self.inferred_at_steps.count(HELD),
            mean_age_steps=sum(ages) / len(ages) if ages else None,
            delay_steps=None if delay_steps is None else tuple(delay_steps),
            motion=motion_of(self.tcp_poses, self.inferred_at_steps, control_hz=control_hz)
            if self.tcp_poses
            else None,
        )

    @property
    def _tcp_reach_m(self) -> float | None:
        """How far the tool centre point ever was from where it began, straight."""
        if not self.tcp_poses:
            return None
        start_m, *path_m = (pose[:3].astype(np.float64) for pose in self.tcp_poses)
        return max((float(np.linalg.norm(one - start_m)) for one in path_m), default=None)

    def _check_finite(self, result: StepResult) -> None:
        values = {"reward": np.array(result.reward), **result.observation.state}
        for name, value in values.items():
            if np.count_nonzero(np.isfinite(value)) < value.size:
                raise SimulationError(
                    f"{self.start.task}, seed {self.start.seed}, step {self.n_steps}: expected a finite "
                    f"'{name}', found {value}. The simulation diverged; please report seed and policy."
                )

    def _digest_state(self, result: StepResult) -> None:
        state = result.observation.state
        for name in sorted(state):
            self.digest.update(np.ascontiguousarray(state[name], dtype="<f4").tobytes())


def check_execution(spec: PolicySpec, chunking: ChunkingSpec) -> None:
    """Raise `SpecMismatchError` unless the policy's chunks can be executed as asked for."""
    chunking.check_chunk_size(spec.chunk_size, policy=spec.name)
    check_reads_committed(spec, chunking)


def check_reads_committed(spec: PolicySpec, chunking: ChunkingSettings) -> None:
    """Raise `SpecMismatchError` unless the policy takes what the mode tells it."""
    if chunking.execution.commits and not spec.reads_committed:
        raise SpecMismatchError(
            f"policy '{spec.name}' does not read what is committed, which chunking.mode={chunking.mode} "
            "tells it. Use another mode, or a policy that joins its chunks (docs/real_time.md)."
        )


def check_start(episode: EpisodeStart, chunking: ChunkingSpec, env: EnvSpec) -> None:
    """Raise unless the episode can begin."""
    if env.is_instructed and not episode.instruction.strip():
        raise MissingInstructionError(
            f"{episode.task}, seed {episode.seed}: the instruction is empty. Give it one in prompts/."
        )

    if chunking.first_inference_step >= episode.horizon_steps:
        raise SpecMismatchError(
            f"{episode.task}: the episode ends after {episode.horizon_steps} steps, before the first "
            f"inference at step {chunking.first_inference_step}. Lower chunking.first_inference_step."
        )


def check_chunk(chunk: object, spec: PolicySpec, action_spec: ActionSpec, log: EpisodeLog) -> None:
    """Raise `InvalidActionError` unless this is a finite float chunk of the declared shape."""
    problem = chunk_problem(chunk, chunk_size=spec.chunk_size, dims=action_spec.dims)
    if problem is not None:
        raise InvalidActionError(
            f"policy '{spec.name}', {log.start.task}, seed {log.start.seed}, inference at step "
            f"{log.n_steps}: {problem}"
        )


def chunk_problem(chunk: object, *, chunk_size: int, dims: Sequence[str]) -> str | None:
    """Return why a policy's answer is not a chunk of `chunk_size` actions; None if it is one."""
    if not isinstance(chunk, ActionChunk) or not isinstance(chunk.actions, np.ndarray):
        found = f"{type(chunk).__name__}"
    elif chunk.actions.shape != (chunk_size, len(dims)):
        found = f"shape {chunk.actions.shape}"
    elif chunk.actions.dtype != np.float32:
        found = f"dtype {chunk.actions.dtype}"
    elif not np.isfinite(chunk.actions).all():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(chunk.actions))[0])
        found = f"{chunk.actions[row, column]} at row {row}, dimension '{dims[column]}'"
    else:
        return None
    return (
        f"expected an ActionChunk of shape ({chunk_size}, {len(dims)}), float32, all finite, found {found}. "
        f"Check the policy's post-processing (un-normalisation, chunk length, dtype)."
    )


def _tcp_pose(result: StepResult) -> list[FloatArray]:
    pose = result.observation.state.get(TCP_POSE)
    return [] if pose is None else [pose.copy()]


def _place(status: TaskStatus, candidate: int | None) -> int | None:
    return status.candidate_places[candidate] if status.candidate_places and candidate is not None else None
