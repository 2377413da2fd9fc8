"""The kit in `vla_eval.testing`: ours pass it, and it notices each kind of broken promise."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from vla_eval.chunking import ChunkingSpec
from vla_eval.config.environment import EnvSettings
from vla_eval.core import ActionChunk, EpisodeStart, FloatArray, ObservationWindow, StepResult
from vla_eval.envs.factory import make_env
from vla_eval.errors import ConformanceError
from vla_eval.policies.context import PolicyContext
from vla_eval.policies.controls.scripted import make_hold, make_random
from vla_eval.specs import PolicySpec
from vla_eval.testing import check_env, check_policy, check_task

FAKE = EnvSettings(task="RememberColor3-v0", simulator="fake", cameras=("base_camera", "hand_camera"))


@pytest.mark.parametrize("n_episodes", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_our_tasks_pass(sampled_task: str, n_episodes: int) -> None:
    check_task(sampled_task, n_episodes=n_episodes)


def test_the_fake_environment_passes() -> None:
    check_env(lambda: make_env(FAKE))


@pytest.mark.parametrize("make", [make_random, make_hold])
def test_our_policies_pass(make: Any) -> None:
    env: Any = make_env(FAKE)
    chunking = ChunkingSpec(n_action_steps=4)
    context = PolicyContext(name="p", env=env.spec, chunking=chunking, n_candidates=3)
    check_policy(lambda: make(context), env.spec)


class BrokenEnv:
    """The fake environment with one promise broken."""

    def __init__(self, fault: str) -> None:
        self._env: Any = make_env(FAKE)
        self.spec = self._env.spec
        self.fault = fault
        self._n_resets = 0
        self._buffer = np.zeros(9, dtype=np.float32)

    def _break(self, result: StepResult) -> StepResult:
        state = dict(result.observation.state)
        images = dict(result.observation.images)
        if self.fault == "past":
            state["qpos"] = state["qpos"] + np.float32(1e-6 * self._n_resets)
        elif self.fault == "buffer":
            self._buffer[:] = state["qpos"]
            state["qpos"] = self._buffer
        elif self.fault == "camera" and images:
            images["hand_camera"] = images["hand_camera"][:64]
        return replace(result, observation=replace(result.observation, state=state, images=images))

    def reset(self, seeds: Any, *, render: bool) -> dict[int, StepResult]:
        self._n_resets += 1
        used = {slot: 1 for slot in seeds} if self.fault == "seed" else seeds
        return {k: self._break(r) for k, r in self._env.reset(used, render=render).items()}

    def step(self, actions: Any, *, render: frozenset[int]) -> dict[int, StepResult]:
        return {k: self._break(r) for k, r in self._env.step(actions, render=render).items()}

    def hold_action(self, slot: int) -> FloatArray:
        action: FloatArray = self._env.hold_action(slot)
        return action

    def close(self) -> None:
        self._env.close()


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("past", "bit-equal episodes in a used environment"),
        ("buffer", "must not share a buffer"),
        ("camera", "Camera 'hand_camera' gives uint8"),
        ("seed", "Different seeds must give different episodes"),
    ],
)
def test_a_broken_environment_is_noticed(fault: str, sentence: str) -> None:
    with pytest.raises(ConformanceError, match=sentence):
        check_env(lambda: BrokenEnv(fault))


class BrokenPolicy:
    """A policy that sums up what it sees, with one promise broken."""

    def __init__(self, fault: str) -> None:
        self.spec = PolicySpec(name="broken", reads="last", cameras=(), states=("qpos",), chunk_size=2)
        self.fault = fault
        self._rng = np.random.default_rng(0)
        self._buffer = np.zeros((2, 7), dtype=np.float32)
        self._sums: dict[int, float] = {}

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        if self.fault == "others":
            self._sums.clear()
        for episode in episodes:
            if self.fault != "kept" or episode.slot not in self._sums:
                self._sums[self._key(episode.slot)] = 0.0

    def _key(self, slot: int) -> int:
        return 0 if self.fault == "mixed" else slot

    def act(self, window: ObservationWindow) -> ActionChunk:
        key = self._key(window.slot)
        self._sums[key] = self._sums.get(key, 0.0) + float(window.last.state["qpos"].sum())
        if self.fault == "writes":
            window.last.state["qpos"][:] = 0
        if self.fault == "buffer":
            return ActionChunk(actions=self._buffer)
        if self.fault == "past":
            return ActionChunk(actions=self._rng.uniform(-1, 1, (2, 7)).astype(np.float32))
        return ActionChunk(actions=np.full((2, 7), self._sums[key], dtype=np.float32))


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("past", r"the same actions after another episode\. Forget everything of a slot"),
        ("kept", r"the same actions after another episode\. Forget everything of a slot"),
        ("mixed", r"beside another episode\. Keep your state by `window\.slot`"),
        ("others", r"when another episode begins .* Keep your state by `window\.slot`"),
        ("writes", "leaves the observations as they are"),
        ("buffer", "must not share a buffer"),
    ],
)
def test_a_broken_policy_is_noticed(fault: str, sentence: str) -> None:
    env: Any = make_env(FAKE)
    with pytest.raises(ConformanceError, match=sentence):
        check_policy(lambda: BrokenPolicy(fault), env.spec)


def test_a_policy_with_memory_by_slot_passes_and_the_check_says_what_it_tried() -> None:
    env: Any = make_env(FAKE)
    said: list[str] = []
    met = check_policy(lambda: BrokenPolicy("none"), env.spec, report=said.append)
    assert met == said
    assert "The same episode seed and observations give the same actions beside another episode." in met
    assert "A chunk is float32 of shape (2, 7) and finite." in met


class NotANumberLater:
    """Gives NaN in row 1, dimension `dz`, of its second chunk."""

    def __init__(self) -> None:
        self.spec = BrokenPolicy("none").spec
        self._n_chunks = 0

    def reset(self, episodes: Sequence[EpisodeStart]) -> None:
        self._n_chunks = 0

    def act(self, window: ObservationWindow) -> ActionChunk:
        actions = np.zeros((2, 7), dtype=np.float32)
        if self._n_chunks == 1:
            actions[1, 2] = np.nan
        self._n_chunks += 1
        return ActionChunk(actions=actions)


def test_a_number_that_is_not_finite_is_named_by_row_dimension_and_step() -> None:
    env: Any = make_env(FAKE)
    # Chunks of two actions: the second one begins at step 2. The first episode of the check has seed 2.
    with pytest.raises(
        ConformanceError, match=r"nan in row 1, dimension 'dz', of the chunk at step 2 \(seed 2\)"
    ):
        check_policy(NotANumberLater, env.spec)
