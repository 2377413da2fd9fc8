"""Run one batch of episodes from start to record. Knows nothing of simulators, models or files.

One control step: episodes that are due for an inference ask the policy for a chunk; the chunk executor
chooses the action; the environment executes it, and renders only if somebody will use the image. What is
counted and recorded on the way is in `episode_log.py`.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from vla_eval.chunking import ChunkExecutor, ChunkingSpec
from vla_eval.core import (
    EpisodeStart,
    FloatArray,
    ObservationWindow,
    Policy,
    SimEnv,
    Stage,
    StepObserver,
    StepResult,
    infer,
)
from vla_eval.cue_view import AS_SHOWN, CueBoxes, CueView, CueViewSettings, cue_locator
from vla_eval.episode_log import EpisodeLog, check_chunk, check_execution, check_start
from vla_eval.latency import DelayTrace, EpisodeDelays
from vla_eval.records import EpisodeRecord
from vla_eval.specs import check_compatible


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutSettings:
    """How to run: chunk execution, whether to render each frame, whether to stop at success."""

    chunking: ChunkingSpec  # how chunks become actions
    # render every frame also for a policy that reads only the last one. Changes no result; for checking
    # exactly that.
    eager_rendering: bool = False
    stop_at_success: bool = False  # end an episode at its first success; success_at_end is then unknown
    steps_after_success: int = 0  # with `stop_at_success`, continue for this many control steps
    # reset the policy in mid-episode: at the first inference at or after this control step it is reset for
    # the episode, and is given no frame of an earlier step. None: never.
    reset_policy_at_step: int | None = None
    # what the policy is given to see of the cue; observers get what was rendered
    cue_view: CueViewSettings = AS_SHOWN
    delay_trace: DelayTrace | None = None  # the delays to replay, where `chunking.delay` names a run


class _Running(NamedTuple):
    """One running episode: what it has come to, what the policy has not been given yet, its chunks."""

    log: EpisodeLog
    view: CueView
    executor: ChunkExecutor


def rollout(
    env: SimEnv,
    policy: Policy,
    episodes: Sequence[EpisodeStart],
    settings: RolloutSettings,
    *,
    observers: Sequence[StepObserver] = (),
    heartbeat: Callable[[Stage], None] = lambda _stage: None,
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
        SpecMismatchError: policy, environment, chunking and view of the cue do not fit together, or the first
            inference is after the end of the episode.
        MissingInstructionError: an episode has no instruction.
        InvalidActionError: the policy returned something that is not a finite chunk.
        SimulationError: the simulator returned a reward or a state that is not finite.
    """
    check_compatible(policy.spec, env.spec)
    check_execution(policy.spec, settings.chunking)
    for episode in episodes:
        check_start(episode, settings.chunking, env.spec)
    boxes = cue_locator(env, settings.cue_view, policy.spec.cameras)
    loop = _Loop(
        env=env, policy=policy, settings=settings, observers=observers, heartbeat=heartbeat, cue_boxes=boxes
    )
    running = active = loop.begin(episodes)
    stop = settings.stop_at_success
    while active:
        loop.infer(active)
        loop.step(active)
        after = settings.steps_after_success if stop else None
        active = [episode for episode in active if not episode.log.is_over(steps_after_success=after)]
    return [loop.record(one) for one in running]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Loop:
    """Who takes part in a rollout."""

    env: SimEnv
    policy: Policy
    settings: RolloutSettings
    observers: Sequence[StepObserver]
    heartbeat: Callable[[Stage], None]
    cue_boxes: Callable[[int], CueBoxes]

    def begin(self, episodes: Sequence[EpisodeStart]) -> list[_Running]:
        self.heartbeat("reset")
        render = bool(self.policy.spec.cameras) or any(o.wants_images(0) for o in self.observers)
        results = self.env.reset({e.slot: e.seed for e in episodes}, render=render)
        starts = [episode.worded(results[episode.slot].wording) for episode in episodes]
        self.policy.reset(starts)
        for start in starts:
            for observer in self.observers:
                observer.on_reset(start, results[start.slot])
        return [self._begun(start, results[start.slot]) for start in starts]

    def _begun(self, start: EpisodeStart, result: StepResult) -> _Running:
        view = CueView(settings=self.settings.cue_view, locate=lambda: self.cue_boxes(start.slot))
        view.note(result)
        log = EpisodeLog.begin(start, result)
        return _Running(
            log=log, view=view, executor=ChunkExecutor(self.settings.chunking, self._delays(start))
        )

    def _delays(self, start: EpisodeStart) -> EpisodeDelays:
        return EpisodeDelays(
            delay=self.settings.chunking.delay,
            seed=start.seed,
            run=start.run,
            control_hz=self.env.spec.control_hz,
            trace=self.settings.delay_trace,
        )

    def record(self, episode: _Running) -> EpisodeRecord:
        chunking = self.settings.chunking
        return episode.log.record(
            self.policy.spec.name,
            chunking.n_action_steps,
            stops_at_success=self.settings.stop_at_success,
            delay_steps=None if isinstance(chunking.delay, int) else episode.executor.delays.steps,
            control_hz=self.env.spec.control_hz,
        )

    def infer(self, active: Sequence[_Running]) -> None:
        """Ask the policy for a chunk for each episode that is due."""
        due = [episode for episode in active if episode.executor.next_inference_step == episode.log.n_steps]
        if not due:
            return
        first_step = self.settings.reset_policy_at_step
        for episode in due:
            if first_step is not None and episode.log.last_inference_step < first_step <= episode.log.n_steps:
                self.policy.reset([episode.log.start])
                episode.view.forget_before(first_step)
        windows = [self._window(episode) for episode in due]
        self.heartbeat("inference")
        began = time.perf_counter()
        chunks = infer(self.policy, windows)
        seconds = time.perf_counter() - began
        for episode, window, chunk in zip(due, windows, chunks, strict=True):
            check_chunk(chunk, self.policy.spec, self.env.spec.action, episode.log)
            episode.executor.submit(episode.log.n_steps, chunk, seconds=seconds)
            episode.log.note_inference(n_frames=len(window.frames))
            for observer in self.observers:
                observer.on_inference(episode.log.start, episode.log.n_steps, chunk)

    def _window(self, episode: _Running) -> ObservationWindow:
        spec = self.policy.spec
        window = episode.view.take(episode.log.start.slot, spec)
        if not spec.reads_committed:
            return window
        n_dims = len(self.env.spec.action.dims)
        return replace(window, committed=episode.executor.committed(episode.log.n_steps, n_dims=n_dims))

    def step(self, active: Sequence[_Running]) -> None:
        executed = {e.log.start.slot: e.executor.action(e.log.n_steps) for e in active}
        actions: dict[int, FloatArray] = {
            slot: self.env.hold_action(slot) if one is None else one.action for slot, one in executed.items()
        }
        render = frozenset(episode.log.start.slot for episode in active if self._renders_next(episode))
        self.heartbeat("step")
        results = self.env.step(actions, render=render)
        for episode in active:
            slot = episode.log.start.slot
            action, result = actions[slot], results[slot]
            episode.log.note_step(executed[slot], action, result, self.env.spec.action)
            episode.view.note(result)
            for observer in self.observers:
                observer.on_step(episode.log.start, action, result)

    def _renders_next(self, episode: _Running) -> bool:
        """Whether somebody will use the images of the coming step."""
        spec, step = self.policy.spec, episode.log.n_steps + 1
        inference_step, horizon_steps = episode.executor.next_inference_step, episode.log.start.horizon_steps
        is_given = spec.is_given(step, inference_step, horizon_steps=horizon_steps)
        for_policy = is_given or episode.view.needs_images(step) or self.settings.eager_rendering
        return (bool(spec.cameras) and for_policy) or any(o.wants_images(step) for o in self.observers)
