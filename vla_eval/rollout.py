"""Run one batch of episodes from start to record. Knows nothing of simulators, models or files.

The way of one control step: whoever is due for an inference is asked for a chunk (the policy sees the
frames since it was last asked, or just the newest one); the chunk executor names the action; the
environment executes it and renders only if somebody will look at the picture.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vla_eval.core import (
    ActionChunk,
    EpisodeStart,
    FloatArray,
    Observation,
    ObservationWindow,
    Policy,
    SimEnv,
    Stage,
    StepObserver,
    StepResult,
    TaskStatus,
)
from vla_eval.errors import InvalidActionError, MissingInstructionError, SimulationError
from vla_eval.policies.chunking import ChunkExecutor, ChunkingSpec
from vla_eval.results.records import EpisodeRecord
from vla_eval.specs import ActionSpec, PolicySpec, check_compatible

TCP_POSE = "tcp_pose"  # the state whose first three numbers are the tool centre point, m


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutSettings:
    """How to run: chunk execution, whether to render each frame, whether to stop at success.

    Attributes:
        chunking: how chunks become actions.
        eager_rendering: render every frame also for a policy that reads only the last one. Changes no
            result; for checking exactly that.
        stop_at_success: end an episode at its first success; success_at_end is then unknown.
        steps_after_success: with `stop_at_success`, go on for so many control steps.
    """

    chunking: ChunkingSpec
    eager_rendering: bool = False
    stop_at_success: bool = False
    steps_after_success: int = 0


@dataclass(slots=True, kw_only=True)
class _Episode:
    """One running episode: what has been seen and done so far."""

    start: EpisodeStart
    executor: ChunkExecutor
    result: StepResult
    window: list[Observation]
    n_steps: int = 0
    success_step: int | None = None
    episode_return: float = 0.0
    n_inferences: int = 0
    n_frames: int = 0
    n_clipped_steps: int = 0
    tcp_start_m: NDArray[np.float64] | None = None
    tcp_reach_m: float | None = None
    done: bool = False
    digest: "hashlib._Hash" = field(default_factory=hashlib.sha256)


def _ignore(_stage: Stage) -> None:
    """Stand in for a heartbeat that nobody listens to."""


def rollout(
    env: SimEnv,
    policy: Policy,
    episodes: Sequence[EpisodeStart],
    settings: RolloutSettings,
    *,
    observers: Sequence[StepObserver] = (),
    heartbeat: Callable[[Stage], None] = _ignore,
) -> list[EpisodeRecord]:
    """Run the episodes side by side, one per slot, and return their records in the same order.

    Args:
        env: an environment with at least the slots that the episodes name.
        policy: the policy; it is reset for these episodes.
        episodes: which seeds to run in which slots.
        settings: how to run them.
        observers: they see everything and change nothing.
        heartbeat: called with what is about to be done, for a watchdog.

    Raises:
        SpecMismatchError: policy, environment and chunking do not fit together.
        MissingInstructionError: an episode has no instruction.
        InvalidActionError: the policy returned something that is no finite chunk.
    """
    check_compatible(policy.spec, env.spec)
    settings.chunking.check_chunk_size(policy.spec.chunk_size, policy=policy.spec.name)
    for episode in episodes:
        if not episode.instruction.strip():
            raise MissingInstructionError(
                f"{episode.task}, seed {episode.seed}: the instruction is empty. Give it one in prompts/."
            )
    running = _begin(env, policy, episodes, settings, observers, heartbeat)
    while active := [episode for episode in running if not episode.done]:
        _infer(policy, active, env.spec.action, observers, heartbeat)
        _step(env, policy.spec, active, settings, observers, heartbeat)
    return [_record(episode, policy.spec, settings) for episode in running]


def _begin(
    env: SimEnv,
    policy: Policy,
    episodes: Sequence[EpisodeStart],
    settings: RolloutSettings,
    observers: Sequence[StepObserver],
    heartbeat: Callable[[Stage], None],
) -> list[_Episode]:
    heartbeat("reset")
    render = bool(policy.spec.cameras) or any(o.wants_images(0) for o in observers)
    results = env.reset({e.slot: e.seed for e in episodes}, render=render)
    policy.reset(episodes)
    running = []
    for start in episodes:
        result = results[start.slot]
        episode = _Episode(
            start=start,
            executor=ChunkExecutor(settings.chunking),
            result=result,
            window=[result.observation],
            tcp_start_m=_tcp_m(result),
        )
        _digest_state(episode, result)
        for observer in observers:
            observer.on_reset(start, result)
        running.append(episode)
    return running


def _infer(
    policy: Policy,
    active: Sequence[_Episode],
    action_spec: ActionSpec,
    observers: Sequence[StepObserver],
    heartbeat: Callable[[Stage], None],
) -> None:
    """Ask the policy for a chunk for each episode that is due."""
    due = [episode for episode in active if episode.executor.infers_at(episode.n_steps)]
    if not due:
        return
    windows = [
        ObservationWindow(
            slot=episode.start.slot,
            frames=tuple(
                _as_declared(observation, policy.spec)
                for observation in (episode.window if policy.spec.reads == "every" else episode.window[-1:])
            ),
        )
        for episode in due
    ]
    heartbeat("inference")
    act_batch: Callable[[Sequence[ObservationWindow]], list[ActionChunk]] | None
    act_batch = getattr(policy, "act_batch", None)
    chunks = act_batch(windows) if act_batch is not None else [policy.act(window) for window in windows]
    for episode, window, chunk in zip(due, windows, chunks, strict=True):
        _check_chunk(chunk, policy.spec, action_spec, episode)
        episode.executor.submit(episode.n_steps, chunk)
        episode.n_inferences += 1
        episode.n_frames += len(window.frames)
        episode.window.clear()
        for observer in observers:
            observer.on_inference(episode.start, episode.n_steps, chunk)


def _as_declared(observation: Observation, spec: PolicySpec) -> Observation:
    """Return what the policy has declared that it reads: observers may have asked for more.

    A missing picture stays missing: `check_compatible` has found each camera in the environment.
    """
    return replace(
        observation,
        images={name: image for name, image in observation.images.items() if name in spec.cameras},
        privileged=observation.privileged if spec.privileged else None,
    )


def _step(
    env: SimEnv,
    spec: PolicySpec,
    active: Sequence[_Episode],
    settings: RolloutSettings,
    observers: Sequence[StepObserver],
    heartbeat: Callable[[Stage], None],
) -> None:
    """Execute one control step in each running episode."""
    actions: dict[int, FloatArray] = {}
    render: set[int] = set()
    for episode in active:
        slot, next_step = episode.start.slot, episode.n_steps + 1
        action = episode.executor.action(episode.n_steps)
        actions[slot] = env.hold_action(slot) if action is None else action
        is_last = next_step >= episode.start.horizon_steps
        policy_looks = bool(spec.cameras) and (
            settings.eager_rendering or (not is_last and _is_for_policy(episode, spec, next_step))
        )
        if policy_looks or any(o.wants_images(next_step) for o in observers):
            render.add(slot)
    heartbeat("step")
    results = env.step(actions, render=frozenset(render))
    for episode in active:
        slot = episode.start.slot
        _account(episode, actions[slot], results[slot], env.spec.action, settings)
        for observer in observers:
            observer.on_step(episode.start, actions[slot], results[slot])


def _is_for_policy(episode: _Episode, spec: PolicySpec, step: int) -> bool:
    """Whether the policy will be given the observation at `step`."""
    inference_step = episode.executor.next_inference_step
    if spec.reads == "every":
        return inference_step < episode.start.horizon_steps  # what comes after the last inference is not seen
    return step == inference_step


def _account(
    episode: _Episode,
    action: FloatArray,
    result: StepResult,
    action_spec: ActionSpec,
    settings: RolloutSettings,
) -> None:
    """Take down what one control step brought."""
    episode.n_steps += 1
    _check_result(episode, result)
    _account_reach(episode, result)
    episode.result = result
    episode.window.append(result.observation)
    episode.episode_return += result.reward
    episode.n_clipped_steps += bool(np.any(action < action_spec.low) or np.any(action > action_spec.high))
    episode.digest.update(np.ascontiguousarray(action, dtype="<f4").tobytes())
    _digest_state(episode, result)
    if result.status.success and episode.success_step is None:
        episode.success_step = episode.n_steps
    stops = settings.stop_at_success and episode.success_step is not None
    since_success = episode.n_steps - (episode.success_step or 0)
    episode.done = (
        episode.n_steps >= episode.start.horizon_steps
        or result.status.fail
        or (stops and since_success >= settings.steps_after_success)
    )


def _account_reach(episode: _Episode, result: StepResult) -> None:
    """Keep how far the tool centre point ever was from where it began; None if its pose is no state."""
    position_m = _tcp_m(result)
    if position_m is not None and episode.tcp_start_m is not None:
        distance_m = float(np.linalg.norm(position_m - episode.tcp_start_m))
        episode.tcp_reach_m = max(episode.tcp_reach_m or 0.0, distance_m)


def _tcp_m(result: StepResult) -> NDArray[np.float64] | None:
    pose = result.observation.state.get(TCP_POSE)
    return None if pose is None else pose[:3].astype(np.float64)


def _check_result(episode: _Episode, result: StepResult) -> None:
    """Raise `SimulationError` unless reward and states are finite."""
    values = {"reward": np.asarray(result.reward), **result.observation.state}
    for name, value in values.items():
        if not np.isfinite(value).all():
            raise SimulationError(
                f"{episode.start.task}, seed {episode.start.seed}, step {episode.n_steps}: expected a finite "
                f"'{name}', found {value}. The simulation diverged; please report the seed and the policy."
            )


def _digest_state(episode: _Episode, result: StepResult) -> None:
    for name in sorted(result.observation.state):
        episode.digest.update(np.ascontiguousarray(result.observation.state[name], dtype="<f4").tobytes())


def _check_chunk(chunk: object, spec: PolicySpec, action_spec: ActionSpec, episode: _Episode) -> None:
    """Raise `InvalidActionError` unless this is a finite float chunk of the declared shape."""
    where = (
        f"policy '{spec.name}', {episode.start.task}, seed {episode.start.seed}, "
        f"inference at step {episode.n_steps}"
    )
    expected = f"an ActionChunk of shape ({spec.chunk_size}, {len(action_spec.dims)}), float32, all finite"
    if not isinstance(chunk, ActionChunk) or not isinstance(chunk.actions, np.ndarray):
        found = f"{type(chunk).__name__}"
    elif chunk.actions.shape != (spec.chunk_size, len(action_spec.dims)):
        found = f"shape {chunk.actions.shape}"
    elif chunk.actions.dtype != np.float32:
        found = f"dtype {chunk.actions.dtype}"
    elif not np.isfinite(chunk.actions).all():
        row, column = (int(i) for i in np.argwhere(~np.isfinite(chunk.actions))[0])
        found = f"{chunk.actions[row, column]} at row {row}, dimension '{action_spec.dims[column]}'"
    else:
        return
    raise InvalidActionError(
        f"{where}: expected {expected}, found {found}. "
        f"Check the policy's post-processing (un-normalisation, chunk length, dtype)."
    )


def _record(episode: _Episode, spec: PolicySpec, settings: RolloutSettings) -> EpisodeRecord:
    status = episode.result.status
    has_candidates = status.n_candidates > 0
    succeeded = episode.success_step is not None
    return EpisodeRecord(
        task=episode.start.task,
        policy=spec.name,
        n_action_steps=settings.chunking.n_action_steps,
        run=episode.start.run,
        seed=episode.start.seed,
        outcome="success" if succeeded else "failure",
        success_once=succeeded,
        success_at_end=None if settings.stop_at_success and succeeded else status.success,
        success_step=episode.success_step,
        n_steps=episode.n_steps,
        target=status.target,
        n_candidates=status.n_candidates if has_candidates else None,
        first_choice=status.first_choice,
        first_choice_success=status.first_choice in status.right_first_choices if has_candidates else None,
        n_wrong_choices=status.n_wrong_choices if has_candidates else None,
        chance_success=status.chance_success,
        episode_return=episode.episode_return,
        n_inferences=episode.n_inferences,
        n_frames=episode.n_frames,
        n_clipped_steps=episode.n_clipped_steps,
        trajectory_sha256=episode.digest.hexdigest(),
        target_place=_place(status, status.target),
        first_choice_place=_place(status, status.first_choice),
        tcp_reach_m=episode.tcp_reach_m,
    )


def _place(status: TaskStatus, candidate: int | None) -> int | None:
    return status.candidate_places[candidate] if status.candidate_places and candidate is not None else None
