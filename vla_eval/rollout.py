"""Run one batch of episodes from start to record. Knows nothing of simulators, models or files.

One control step: each episode that is due for an inference asks the policy for a chunk (the policy is given
the frames since its last inference, or only the newest one); the chunk executor chooses the action; the
environment executes it, and renders only if somebody will use the image. What is counted, checked and
recorded on the way is in `episode_log.py`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from vla_eval.chunking import ChunkExecutor, ChunkingSpec
from vla_eval.core import (
    BatchPolicy,
    EpisodeStart,
    FloatArray,
    Observation,
    ObservationWindow,
    Policy,
    SimEnv,
    Stage,
    StepObserver,
    StepResult,
)
from vla_eval.cue_view import AS_SHOWN, CueBoxes, CueLocator, CueView, CueViewSettings
from vla_eval.episode_log import EpisodeLog, check_chunk, check_first_inference, check_instruction
from vla_eval.errors import SpecMismatchError
from vla_eval.records import EpisodeRecord
from vla_eval.specs import PolicySpec, check_compatible


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutSettings:
    """How to run: chunk execution, whether to render each frame, whether to stop at success.

    Attributes:
        chunking: how chunks become actions.
        eager_rendering: render every frame also for a policy that reads only the last one. Changes no
            result; for checking exactly that.
        stop_at_success: end an episode at its first success; success_at_end is then unknown.
        steps_after_success: with `stop_at_success`, continue for this many control steps.
        reset_policy_at_step: reset the policy in mid-episode: at the first inference at or after this
            control step it is reset for the episode, and is given no frame of an earlier step. None: never.
        cue_view: what the policy is given to see of the cue; observers get what was rendered.
    """

    chunking: ChunkingSpec
    eager_rendering: bool = False
    stop_at_success: bool = False
    steps_after_success: int = 0
    reset_policy_at_step: int | None = None
    cue_view: CueViewSettings = AS_SHOWN


@dataclass(slots=True, kw_only=True)
class _Running:
    """One running episode: what the policy has not been given yet, its chunks, its log."""

    log: EpisodeLog
    view: CueView
    executor: ChunkExecutor
    window: list[Observation]
    reset_policy_at_step: int | None
    done: bool = False

    @property
    def start(self) -> EpisodeStart:
        return self.log.start

    @property
    def step(self) -> int:
        return self.log.n_steps


def _worded(episode: EpisodeStart, reset: StepResult) -> EpisodeStart:
    """Return the episode with the words in its instruction that differ per episode."""
    instruction = episode.instruction
    for word, value in reset.wording.items():
        instruction = instruction.replace(f"{{{word}}}", value)
    return episode if instruction == episode.instruction else replace(episode, instruction=instruction)


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
        SpecMismatchError: policy, environment, chunking and view of the cue do not fit together, or the first
            inference is after the end of the episode.
        MissingInstructionError: an episode has no instruction.
        InvalidActionError: the policy returned something that is no finite chunk.
        SimulationError: the simulator returned a reward or a state that is not finite.
    """
    check_compatible(policy.spec, env.spec)
    settings.chunking.check_chunk_size(policy.spec.chunk_size, policy=policy.spec.name)
    for episode in episodes:
        check_instruction(episode)
        check_first_inference(episode, settings.chunking)
    if settings.cue_view.hides and policy.spec.cameras and not isinstance(env, CueLocator):
        raise SpecMismatchError(
            f"cue_view={settings.cue_view.kind}: {env.spec.task}: this environment cannot tell where in its "
            "images the cue is. Use another one, or leave this view out."
        )
    loop = _Loop(env=env, policy=policy, settings=settings, observers=observers, heartbeat=heartbeat)
    running = loop.begin(episodes)
    while active := [episode for episode in running if not episode.done]:
        loop.infer(active)
        loop.step(active)
    return [
        episode.log.record(
            policy.spec.name, settings.chunking.n_action_steps, stops_at_success=settings.stop_at_success
        )
        for episode in running
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Loop:
    """Who takes part in a rollout."""

    env: SimEnv
    policy: Policy
    settings: RolloutSettings
    observers: Sequence[StepObserver]
    heartbeat: Callable[[Stage], None]

    def begin(self, episodes: Sequence[EpisodeStart]) -> list[_Running]:
        """Reset environment and policy."""
        self.heartbeat("reset")
        render = bool(self.policy.spec.cameras) or any(o.wants_images(0) for o in self.observers)
        results = self.env.reset({e.slot: e.seed for e in episodes}, render=render)
        episodes = [_worded(episode, results[episode.slot]) for episode in episodes]
        self.policy.reset(episodes)
        for start in episodes:
            for observer in self.observers:
                observer.on_reset(start, results[start.slot])
        return [self._begun(start, results[start.slot]) for start in episodes]

    def _begun(self, start: EpisodeStart, result: StepResult) -> _Running:
        view = CueView(settings=self.settings.cue_view, locate=lambda: self._cue_boxes(start.slot))
        return _Running(
            log=EpisodeLog.begin(start, result),
            view=view,
            executor=ChunkExecutor(self.settings.chunking),
            window=[view.seen(result.observation, result.status.phase)],
            reset_policy_at_step=self.settings.reset_policy_at_step,
        )

    def _cue_boxes(self, slot: int) -> CueBoxes:
        if isinstance(self.env, CueLocator) and self.policy.spec.cameras:
            return self.env.cue_boxes(slot)
        return {}

    def infer(self, active: Sequence[_Running]) -> None:
        """Ask the policy for a chunk for each episode that is due."""
        due = [episode for episode in active if episode.executor.infers_at(episode.step)]
        if not due:
            return
        policy, spec = self.policy, self.policy.spec
        for episode in due:
            self._reset_in_mid_episode(episode)
        windows = [_window(episode, spec) for episode in due]
        self.heartbeat("inference")
        if isinstance(policy, BatchPolicy):
            chunks = policy.act_batch(windows)
        else:
            chunks = [policy.act(window) for window in windows]
        for episode, window, chunk in zip(due, windows, chunks, strict=True):
            check_chunk(chunk, spec, self.env.spec.action, episode.log)
            episode.executor.submit(episode.step, chunk)
            episode.log.note_inference(n_frames=len(window.frames))
            episode.window.clear()
            for observer in self.observers:
                observer.on_inference(episode.start, episode.step, chunk)

    def _reset_in_mid_episode(self, episode: _Running) -> None:
        """Let the policy forget what was before a step, once, if the settings ask for it."""
        first_step = episode.reset_policy_at_step
        if first_step is None or episode.step < first_step:
            return
        self.policy.reset([episode.start])
        episode.window = [frame for frame in episode.window if frame.step >= first_step]
        episode.reset_policy_at_step = None

    def step(self, active: Sequence[_Running]) -> None:
        """Execute one control step in each running episode."""
        actions: dict[int, FloatArray] = {}
        for episode in active:
            action = episode.executor.action(episode.step)
            slot = episode.start.slot
            actions[slot] = self.env.hold_action(slot) if action is None else action
        render = frozenset(episode.start.slot for episode in active if self._needs_images(episode))
        self.heartbeat("step")
        results = self.env.step(actions, render=render)
        for episode in active:
            slot = episode.start.slot
            episode.log.note_step(actions[slot], results[slot], self.env.spec.action)
            episode.window.append(episode.view.seen(results[slot].observation, results[slot].status.phase))
            episode.done = _is_done(episode, results[slot], self.settings)
            for observer in self.observers:
                observer.on_step(episode.start, actions[slot], results[slot])

    def _needs_images(self, episode: _Running) -> bool:
        """Whether the observation after the coming step must hold images."""
        step, spec = episode.step + 1, self.policy.spec
        is_last = step >= episode.start.horizon_steps
        is_given = not is_last and _is_given(episode, spec, step)
        for_policy = self.settings.eager_rendering or is_given or episode.view.needs_images(step)
        return (bool(spec.cameras) and for_policy) or any(o.wants_images(step) for o in self.observers)


def _is_given(episode: _Running, spec: PolicySpec, step: int) -> bool:
    """Whether the policy will be given the observation at `step`."""
    inference_step = episode.executor.next_inference_step
    if spec.reads == "every":
        return inference_step < episode.start.horizon_steps  # nothing after the last inference is given
    return step == inference_step


def _window(episode: _Running, spec: PolicySpec) -> ObservationWindow:
    frames = episode.window if spec.reads == "every" else episode.window[-1:]
    return ObservationWindow(
        slot=episode.start.slot, frames=tuple(_as_declared(frame, spec) for frame in frames)
    )


def _as_declared(observation: Observation, spec: PolicySpec) -> Observation:
    """Return what the policy has declared that it reads: observers may have asked for more.

    A missing image stays missing: `check_compatible` has found each camera in the environment.
    """
    return replace(
        observation,
        images={name: image for name, image in observation.images.items() if name in spec.cameras},
        privileged=observation.privileged if spec.privileged else None,
    )


def _is_done(episode: _Running, result: StepResult, settings: RolloutSettings) -> bool:
    success_step = episode.log.success_step
    stops = settings.stop_at_success and success_step is not None
    return (
        episode.step >= episode.start.horizon_steps
        or result.status.fail
        or (stops and episode.step - (success_step or 0) >= settings.steps_after_success)
    )
