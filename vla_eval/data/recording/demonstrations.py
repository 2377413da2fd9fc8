"""One demonstration in two passes: the expert acts; its actions are replayed, checked, rendered."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vla_eval.chunking import ChunkingSpec
from vla_eval.control_modes import ABSOLUTE_MODES, DELTA_RAD
from vla_eval.core import (
    ActionChunk,
    EpisodeStart,
    FloatArray,
    ImageArray,
    ObservationWindow,
    Policy,
    SimEnv,
    Stage,
    StepObserver,
    StepResult,
)
from vla_eval.data.manifest import decode_actions, encode_actions
from vla_eval.errors import RecordingError
from vla_eval.rollout import RolloutSettings, rollout
from vla_eval.seeding import Stream, generator
from vla_eval.specs import EnvSpec, PolicySpec
from vla_eval.strict.json_text import Count, Positive
from vla_eval.task_state import Phase

SLOT = 0
ONE_BY_ONE = ChunkingSpec(n_action_steps=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempt:
    """What the expert did with one seed; for the fields see `RecordedEpisode`."""

    seed: Count
    success_step: Positive | None
    n_steps: Positive
    cue_steps: Count
    delay_steps: Count
    actions: str
    intended_actions: str | None
    states_sha256: str


@dataclass(slots=True)
class EpisodeLog(StepObserver):
    """Keeps all results of one episode, and asks for images of the first `n_images`."""

    n_images: int = 0
    results: list[StepResult] = field(default_factory=list)
    asked: list[FloatArray] = field(default_factory=list)

    def wants_images(self, step: int) -> bool:
        """The last observation needs no image: no action follows it."""
        return step < self.n_images

    def on_reset(self, episode: EpisodeStart, result: StepResult) -> None:
        """Keep the reset's result."""
        self.results.append(result)

    def on_step(self, episode: EpisodeStart, action: FloatArray, result: StepResult) -> None:
        """Keep action and result."""
        self.asked.append(action)
        self.results.append(result)

    def executed(self) -> FloatArray:
        """Return the executed actions, (n_steps, A)."""
        rows = [result.executed_action for result in self.results[1:]]
        return np.stack([row for row in rows if row is not None]).astype(np.float32)


class RecordedActions:
    """A policy that does again what was done."""

    def __init__(self, actions: FloatArray) -> None:
        self._actions = actions
        self.spec = PolicySpec(name="recorded", reads="last", cameras=(), states=(), chunk_size=1)

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        """Nothing to forget."""

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the action of this step."""
        step = window.last.step
        return ActionChunk(actions=self._actions[step : step + 1])


class NoisyEnv:
    """A `SimEnv` whose arm is pushed: noise in units of a delta action; a tenth of it in m and rad."""

    def __init__(self, env: SimEnv, std: float) -> None:
        self._env = env
        is_absolute = env.spec.action.control_mode in ABSOLUTE_MODES
        self._std = std * DELTA_RAD if is_absolute else std
        self._rng: dict[int, np.random.Generator] = {}

    @property
    def spec(self) -> EnvSpec:
        """That of the environment."""
        return self._env.spec

    def reset(self, seeds: Mapping[int, int], *, render: bool) -> dict[int, StepResult]:
        """Begin episodes; each has a generator of its own."""
        self._rng.update({slot: generator(seed, Stream.NOISE) for slot, seed in seeds.items()})
        return self._env.reset(seeds, render=render)

    def step(self, actions: Mapping[int, FloatArray], *, render: frozenset[int]) -> dict[int, StepResult]:
        """Execute the actions with noise."""
        return self._env.step({slot: self._pushed(slot, row) for slot, row in actions.items()}, render=render)

    def hold_action(self, slot: int) -> FloatArray:
        """Return that of the environment."""
        return self._env.hold_action(slot)

    def close(self) -> None:
        """Release the simulator."""
        self._env.close()

    def _pushed(self, slot: int, action: FloatArray) -> FloatArray:
        pushed = action.copy()
        n_arm_dims = len(pushed) - 1  # the last one is the gripper
        pushed[:n_arm_dims] += self._rng[slot].normal(0, self._std, n_arm_dims).astype(np.float32)
        return self.spec.action.clipped(pushed)


def states_digest(results: Sequence[StepResult]) -> str:
    """Return the sha256 of all states, from reset to the end: by name, float32, little endian."""
    digest = hashlib.sha256()
    for result in results:
        state = result.observation.state
        for name in sorted(state):
            digest.update(np.ascontiguousarray(state[name], dtype="<f4").tobytes())
    return digest.hexdigest()


def images_digests(frames: Sequence[Mapping[str, ImageArray]]) -> dict[str, str]:
    """Return camera -> sha256 of its frames, one after the other, uint8."""
    cameras = sorted(frames[0]) if frames else []
    digests = {camera: hashlib.sha256() for camera in cameras}
    for frame in frames:
        for camera in cameras:
            digests[camera].update(np.ascontiguousarray(frame[camera]).tobytes())
    return {camera: digest.hexdigest() for camera, digest in digests.items()}


class PhaseSteps(NamedTuple):
    """Lengths of the first two phases of an episode, in control steps."""

    cue: int
    delay: int


def phase_steps(phases: Sequence[Phase | None]) -> PhaseSteps:
    """Return how long the phases of an episode were; `phases`: at reset, and after each control step."""
    cue = next((i for i, phase in enumerate(phases) if phase != "cue"), len(phases))
    response = next((i for i, phase in enumerate(phases) if phase == "response"), len(phases))
    return PhaseSteps(cue, response - cue)


def attempt(
    env: SimEnv,
    expert: Policy,
    start: EpisodeStart,
    settings: RolloutSettings,
    *,
    heartbeat: Callable[[Stage], None],
) -> Attempt:
    """Let the expert act on one seed, without images; errors as `rollout`."""
    log = EpisodeLog()
    (record,) = rollout(env, expert, [start], settings, observers=[log], heartbeat=heartbeat)
    executed = log.executed()
    intended = env.spec.action.clipped(np.stack(log.asked))
    steps = phase_steps([result.status.phase for result in log.results])
    return Attempt(
        seed=start.seed,
        success_step=record.success_step,
        n_steps=len(executed),
        cue_steps=steps.cue,
        delay_steps=steps.delay,
        actions=encode_actions(executed),
        intended_actions=None if np.array_equal(executed, intended) else encode_actions(intended),
        states_sha256=states_digest(log.results),
    )


def replay_actions(
    env: SimEnv,
    start: EpisodeStart,
    actions: FloatArray,
    *,
    heartbeat: Callable[[Stage], None],
    with_pictures: bool,
) -> EpisodeLog:
    """Execute recorded actions, (n_steps, A); return all results, from reset on."""
    log = EpisodeLog(n_images=len(actions) if with_pictures else 0)
    settings = RolloutSettings(chunking=ONE_BY_ONE)
    rollout(env, RecordedActions(actions), [start], settings, observers=[log], heartbeat=heartbeat)
    return log


def replay_attempt(
    env: SimEnv, start: EpisodeStart, attempt: Attempt, *, heartbeat: Callable[[Stage], None]
) -> EpisodeLog:
    """Replay an attempt, with images (`RecordingError` if the states are not those of the attempt)."""
    actions = decode_actions(attempt.actions, n_dims=len(env.spec.action.dims))
    log = replay_actions(env, start, actions, heartbeat=heartbeat, with_pictures=True)
    if states_digest(log.results) != attempt.states_sha256:
        raise RecordingError(
            f"{start.task}, seed {start.seed}: expected the same actions to lead to the same states, bit for "
            f"bit, with and without rendering; they do not. Has the machine or the simulator changed since "
            f"the recording was started? Record into a new --out; if it happens again, report it."
        )
    return log
